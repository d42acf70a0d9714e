"""Several captures of one object, turned on a board before a fixed camera, joined into one closed, relightable mesh.

In the order of use:

    fuse_run          `polcap fuse`: processes the views, runs the path, writes maps, asset, report and verdict
    session_views     the views of a session, read from their folders
    session           processes them: one color calibration, one camera, poses, masks, maps
    view_path         the stages of one view: read it first
    each_view         runs a step on all views; a view may fail alone
    fusion_path       the stages from the views' maps to the textures: read it second
    values            views, poses, closed meshes

  Poses
    board_corners     corners of the board in a view
    poses             camera and poses from the corners in all views
    object_features   features of the object in a view
    feature_poses     camera and poses without a board, from these features
    view_maps         maps of a view for the session's camera, with the pose
    joining           one frame for sets of views between which the object was laid on another side

  Masks
    board_eraser      a picture without the board
    mask_without_board  the object's mask, found in this picture
    silhouettes       which points of a grid lie inside a mask, and which of its pixels they cover
    mask_agreement    removes parts of masks that no other view confirms, and finds wrong masks

  Shape
    shape             masks and normals -> closed mesh
    small_views       views at the resolution of the shape
    hull              largest body that all silhouettes allow
    carving           hollows that no silhouette shows
    normal_surface    surface with the measured normals
    closed_mesh       signed distances -> closed mesh; decimation

  Textures
    atlas             charts, and the point of the surface at each texel
    baking            means of the views' maps at each texel
    material_fit      F0, roughness and scale of the albedo by material
    lobe_profiles     radiance of a material by half-angle
    filling           values where no view saw the surface
    comparison        normals and photographs of each view against the fused object
    fused_maps        the folder maps/, and the source of exports
    mesh_occlusion    ambient occlusion of a closed mesh
    object_pictures   pictures of the object from any side
    fused_page        report.json and report.html
"""
