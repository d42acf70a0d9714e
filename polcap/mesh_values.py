"""Triangle meshes and assets, as exporters need them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from polcap.image_values import ArrayValue, Faces, Floats, TexturePixels


@dataclass(frozen=True, repr=False)
class Mesh(ArrayValue):
    """A triangle mesh with texture coordinates, as exporters need it, and figures on its boundary."""

    vertices: Floats  # (V, 3) in `frame`; metres where `metric`
    normals: Floats  # (V, 3) unit
    uv: Floats  # (V, 2) 0…1, v down (glTF)
    tangents: Floats  # (V, 4) unit, w = handedness
    faces: Faces  # (F, 3) counter-clockwise seen from outside
    metric: bool
    pieces: int = 1  # number of separate parts, without specks
    cuts: float = 0.0  # length of the boundary inside the mask, both sides, over the length along the mask's outline
    cut_px: float = 0.0  # length of the cuts inside the mask, one side, px of the maps
    raggedness: float = 0.0  # length of the boundary over its smoothed length, minus 1; before smoothing
    frame: Literal["camera", "board"] = "camera"


@dataclass(frozen=True, repr=False, kw_only=True)
class ReliefMesh(Mesh):
    """The surface that one view shows, as a mesh over its depth map; unless metric, its median depth is 1."""

    depth: Floats  # (H, W) along the optical axis, growing away from the camera; NaN outside


@dataclass(frozen=True, repr=False)
class Asset(ArrayValue):
    """A 3-D asset: mesh with glTF textures and material factors."""

    mesh: Mesh
    base_color: TexturePixels  # (H, W, 3) sRGB; (2H, 2W, 3) with the detail of RAW pixels
    occlusion_roughness_metallic: TexturePixels  # (H, W, 3) linear
    normal: TexturePixels  # (H, W, 3) tangent space, +Y
    specular_color: TexturePixels  # (H, W, 3) sRGB, to be multiplied by the factor
    specular_factor: tuple[float, float, float]  # KHR_materials_specular specularColorFactor
    ior: float
    displacement: TexturePixels | None = None  # (H, W) 0 at the farthest point, 1 at the nearest
    curvature: TexturePixels | None = None  # (H, W) ½ flat, above convex, below concave
    object_normal: TexturePixels | None = None  # (H, W, 3) camera frame, n * 0.5 + 0.5
    albedo_sigma: float | None = None  # as in `SurfaceMaps`
    turned_deg: int = 0  # of mesh and object normals from the mesh's frame, counter-clockwise about z; 0 to 270

    @property
    def has_occlusion(self) -> bool:
        """Whether ambient occlusion darkens any texel; else its channel is 1."""
        return bool(np.ptp(self.occlusion_roughness_metallic[..., 0]))
