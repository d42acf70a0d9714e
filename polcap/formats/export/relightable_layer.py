"""Makes the pictures of a relightable layer, for viewers that shade an image by Ward's law, such as OpenLIME.

References
----------
Ward, Measuring and modeling anisotropic reflection, SIGGRAPH 1992, eq. (4).
"""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from polcap.formats.export import encoders, texture_set
from polcap.formats.export.texture_set import Texture
from polcap.image_values import TexturePixels
from polcap.mesh_values import Asset, ReliefMesh
from polcap.optics import color, outline

NO_NORMAL = 128  # a normal of length 0, by which viewers leave a pixel out


def pictures(asset: Asset) -> dict[str, Texture]:
    """Albedo, F0, gloss and normals of an asset as 8-bit pictures of the size of its base color.

    Gloss is 1 − √roughness, so that Ward's slope parameter is (1 − gloss)⁴ = roughness². The pictures are turned as
    the mesh is. Outside the object the normal is the zero vector and all other pictures are 0; along its outline the
    colors blend into black. The asset must be of one view or a plane, with its object-space normals; a plane has no
    outside.
    """
    assert asset.object_normal is not None
    height, width = asset.base_color.shape[:2]
    coverage = np.ones((height, width), np.float32)
    if isinstance(asset.mesh, ReliefMesh):
        coverage = np.asarray(cv2.resize(outline.matte(np.isfinite(asset.mesh.depth)), (width, height)))
    rough = encoders.eight_bits(texture_set.roughness(asset))
    gloss = np.rint(255 - np.sqrt(255.0 * np.arange(256))).astype(np.uint8)[rough]  # 255 (1 - √(rough/255))
    f0 = color.srgb_eight_bits(texture_set.reflectance(asset))
    made = {
        "albedo": texture_set.base_color(asset),
        "specular": Texture(f0, color=True, meaning="F0, sRGB-encoded"),
        "normal": texture_set.object_normal(asset),
        "gloss": Texture(gloss, color=False, meaning="gloss, linear: 1 - square root of the perceptual roughness"),
    }

    def on_object(picture: Texture, outside: int) -> TexturePixels:
        resized: Any = cv2.resize(encoders.eight_bits(picture), (width, height))
        if picture.color:  # the backdrop is black
            return color.srgb_eight_bits(color.decode_srgb(resized / np.float32(255)) * coverage[..., None])
        inside = coverage > 0
        return np.where(inside if resized.ndim == 2 else inside[..., None], resized, np.uint8(outside))

    shown = {name: on_object(one, NO_NORMAL if name == "normal" else 0) for name, one in made.items()}
    turns = asset.turned_deg // 90
    return {name: replace(one, pixels=np.rot90(shown[name], turns)) for name, one in made.items()}
