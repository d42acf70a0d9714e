"""From meshes and materials to the network's weights; the only room that imports torch.

In the order a sample meets them:

    shapes      random closed meshes
    gbuffers    meshes -> a cache of views: normal, depth, position
    bounce      light that one part of a view throws on another
    materials   a view -> diffuse, specular, roughness, refractive index, bumped normal; gloss draws how surfaces
                reflect and by what law their bodies polarize
    camera      Stokes parameters -> what three noisy photographs would have measured of them
    dataset     all of these -> a batch: network channels and truth
    model       channels -> maps; profiles and palette are its parts that read gloss and draw albedo
    variants    the network with one thing taken away
    loss        maps against truth
    loop        optimizers (muon), learning rate, averaged weights, checkpoints; arithmetic: bf16 or fp32
    train       the main network's batches and losses in that loop
    validation  errors on held-out pictures during training
    export      weights -> ONNX
    corpus      the same simulator's pictures and truth as files
    evaluate    error of every map on fixed pictures of held-out meshes and materials, of which
                protocol makes one at a time (patterns: its materials, transport: its light), baselines
                estimates without a network, score judges, and tables and panel tell
    real        error of normals on photographs that come with measured ones

The object's mask has a network of its own: mask_views traces objects before a backdrop, mask_scenes dresses and
lights them, mask_pictures keeps them as files, mask_model learns from those in mask_train.

The fine pass has one too: relief bends traced normals, fine_pictures photographs them and asks the first network,
fine_model learns what is missing in fine_train. All three learn in the same loop.
"""
