"""Assets for other programs.

gltf          GLB with mesh, material and textures
glb_geometry  the mesh of a GLB: floats, integers or Draco
obj           OBJ, MTL and EXR textures
ply_stl       the mesh alone, PLY with a color per vertex, and STL
usd           USD with OpenPBR and UsdPreviewSurface; USDZ
web_page      a page that shows the GLB without a network
materialx     MaterialX 1.39, and the OpenPBR node graph
exr_layers    all maps as layers of one EXR, in a chosen color space
texture_set   the textures, packed for each kind of program
presets       files, names and packing for one program each
encoders      PNG, JPEG, WebP, KTX2; animated WebP and MP4
provenance    the origin of an asset, as a sidecar file
"""
