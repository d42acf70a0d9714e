"""Several captures of a flat sample on the board, from above and from the sides, become one material with its maps.

In the order of use:

    material_run      `polcap material`: processes the views, runs the path, writes maps, asset, report and verdict
    material_session  processes the views: one color calibration, poses from the board, texel grid
    stokes_view       the stages of one view up to its Stokes parameters
    material_path     the stages from these to the maps: read it first
    texel_grid        texels on the board's plane, and directions and light of each view there

  Stages
    board_focus       blur of each view, and its usable paper
    flash_light       the flash's place and energy in each view, from the board's paper
    coarse_relief     height from parallax and normals, on coarse texels
    rectification     Stokes parameters of all views on the texels
    gloss_groups      roughness and F0 of each material
    texel_maps        normal, albedo, roughness and F0 of each texel, with doubts
    height_map        metric height, filled texels, ambient occlusion
    tiling            seamless maps

  Used by several stages
    texel_stokes      resampling of the views
    texel_fit         least squares of many texels at once

  Output
    material_maps     the folder maps/, and the source of exports
    material_page     report.json and report.html
"""
