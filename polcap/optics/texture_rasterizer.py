"""Rasterization of a mesh onto its texture: the triangle at each pixel, and values interpolated there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.mesh_values import Mesh

_SLACK = 1e-4  # px and barycentric coordinates by which a pixel may miss a triangle, so that none falls between two


@dataclass(frozen=True)
class TexturePoints:
    """Points of a mesh at the N covered pixels of its texture."""

    corners: NDArray[np.int32]  # (N, 3) vertices of the triangle
    weights: Floats  # (N, 2) of the second and of the third corner
    covered: Bools  # (H, W)

    def interpolate(self, value: Floats) -> Floats:
        """Values (N, C) at the pixels, from those (V, C) of the vertices."""
        w1, w2 = self.weights.T[..., None]
        out = value[self.corners[:, 0]] * (1 - w1 - w2)
        out += value[self.corners[:, 1]] * w1
        out += value[self.corners[:, 2]] * w2
        return np.asarray(out)


def rasterize_frames(mesh: Mesh, height: int, width: int) -> tuple[Floats, Bools]:
    """A mesh's normals and tangents (N, 7), interpolated at the covered pixels, and the mask (H, W) of these."""
    points = rasterize(mesh.uv, mesh.faces, height, width)
    return points.interpolate(np.concatenate([mesh.normals, mesh.tangents], axis=-1, dtype=np.float32)), points.covered


def rasterize(uv: Floats, faces: NDArray[np.int32], height: int, width: int) -> TexturePoints:
    """Find the triangle (faces (F, 3), with texture coordinates uv (V, 2)) at each pixel of a texture.

    Only triangles that face the camera count: walls and back have no part of the texture. Where several cover a pixel
    the last one counts.
    """
    place = uv * np.array([width, height]) - 0.5
    corner = place[faces]  # (F, 3, 2) x, y [px]
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    facing = np.flatnonzero(area < 0)  # v runs down
    corner, one, two, area = corner[facing], one[facing], two[facing], area[facing]
    first = np.ceil(corner.min(axis=1) - _SLACK).astype(np.int32)
    extent = np.floor(corner.max(axis=1) + _SLACK).astype(np.int32) - first
    offset = (first - corner[:, 0]).astype(np.float32)
    across, down = ((v / area[:, None]).astype(np.float32) for v in (one, two))
    # barycentric coordinates of the second and third corner at the first pixel; they are linear in the pixel
    second = offset[:, 0] * down[:, 1] - offset[:, 1] * down[:, 0]
    third = across[:, 0] * offset[:, 1] - across[:, 1] * offset[:, 0]
    owner = np.full(height * width, -1, np.int32)
    weights = np.empty((height * width, 2), np.float32)
    for y in range(int(extent[:, 1].max(initial=-1)) + 1):
        reaching = np.flatnonzero(extent[:, 1] >= y)
        for x in range(int(extent[reaching, 0].max(initial=-1)) + 1):
            f = reaching[extent[reaching, 0] >= x]
            w1 = second[f] + (x * down[f, 1] - y * down[f, 0])
            w2 = third[f] + (y * across[f, 0] - x * across[f, 1])
            hit = (w1 > -_SLACK) & (w2 > -_SLACK) & (w1 + w2 < 1 + _SLACK)
            f = f[hit]
            pixel = (first[f, 1] + y) * width + first[f, 0] + x
            owner[pixel] = f
            weights[pixel, 0], weights[pixel, 1] = w1[hit], w2[hit]
    covered = owner >= 0
    return TexturePoints(faces[facing][owner[covered]], weights[covered], covered.reshape(height, width))
