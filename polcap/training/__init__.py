"""Training and evaluation of the networks, from meshes and materials to weights; the only room that imports torch.

Training of the main network, in the order in which a picture passes:

    random_shapes     random closed meshes; `flat_shapes`: flat and sharp-edged ones
    traced_views      meshes -> cache of views: normal, depth, position
    bounced_light     light that one part of an object throws on another
    materials         a view -> diffuse, specular, roughness, refractive index, bumped normal; `gloss` draws their gloss
    camera_errors     Stokes parameters -> measurements by three noisy photographs
    simulator         all of these -> a batch: network channels and truth
    main_network      channels -> maps; its parts `gloss_profiles` and `recurring_colors`, its ablations `variants`
    loss              estimated maps against truth
    progress          lines of text while tracing and training
    loop              optimizers (`muon`), learning rate, averaged weights, checkpoints
    train             the main network in that loop
    validation        errors on held-out pictures during training
    onnx_export       weights -> ONNX

Training of the mask network, and of the refinement network; both are a `unet`:

    mask_views        objects in front of a backdrop, traced
    mask_scenes       their materials, light and chart; `backdrop_patterns` draws the backdrop
    mask_train        the mask network in the training loop
    relief            random fine relief on traced normals
    fine_train        the refinement network in the training loop

Evaluation:

    evaluate                errors of every map (`map_errors`), for a model and for `evaluation_baselines`
    evaluation_protocol     the fixed pictures: `evaluation_materials` under the light of `light_transport`
    evaluation_page         the result as a page
    ablation_study          all variants of the network, trained and evaluated
    evaluation_photographs  errors of the normals on photographs with measured normals, without torch
    scores                  figures by name and their table

Data:

    import_data       meshes and textures of other people -> the data folder of `polcap train`
    dataset_files     simulated pictures and their truth as files
"""
