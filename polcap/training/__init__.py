"""Training and evaluation of the networks, from meshes and materials to weights; the only room that imports torch.

Training of the main network, in the order in which a picture passes:

    random_shapes     random closed meshes
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

The mask's network: `mask_views` traces objects before a backdrop, `mask_scenes` adds materials, light and chart
(`backdrop_patterns`), `mask_train` stores them and trains. The refinement network: `relief` changes traced normals,
`fine_train` photographs them, runs the main network and trains. Both are a `unet`.

Evaluation: `evaluate` measures the error of every map (`map_errors`) on fixed pictures (`evaluation_protocol`, of
`evaluation_materials` in `light_transport`) against `evaluation_baselines`; `evaluation_page` shows the result.
`ablation_study` trains and evaluates all variants.
`evaluation_photographs` measures normals on photographs that come with measured ones.

`import_data` converts meshes and textures of other people.
`dataset_files` writes the simulated pictures and their truth as files.
"""
