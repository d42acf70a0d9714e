"""Synthetic captures: renders random scenes through a simulated camera, and writes capture folders with the truth.

shooting            a capture: brackets of DNGs, and the true maps
all_around          captures of one object from all sides, on a board
flat_views          captures of a flat sample on the board, by a camera that is moved about it
calibration_frames  calibration photographs of a known camera, lens, polarizer and flash
scenes              random scenes
render              Stokes parameters of a scene at any pixel position
forward_camera      lens distortion, color mosaic, noise, DNG
trace               rays against a shape: `distance_fields`, or a mesh by `optics.mesh_tracer`
scene_materials     albedo, F0, roughness and relief of the object
interreflection     light that parts of a mesh throw on each other
color_checker       the chart
laid_board          the board under the object
"""
