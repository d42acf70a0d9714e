"""From meshes and materials to the network's weights; the only room that imports torch.

In the order a sample meets them:

    shapes      random closed meshes
    gbuffers    meshes -> a cache of views: normal, depth, position
    materials   a view -> diffuse, specular, roughness, refractive index, bumped normal
    camera      Stokes parameters -> what three noisy photographs would have measured of them
    dataset     all of these -> a batch: network channels and truth
    model       channels -> maps
    variants    the network with one thing taken away
    loss        maps against truth
    train       the loop, checkpoints, metrics
    export      weights -> ONNX
    evaluate    error of every map on fixed pictures of held-out meshes and materials, of which
                protocol makes one at a time (patterns: its materials, transport: its light), baselines
                estimates without a network, score judges, and tables and panel tell
"""
