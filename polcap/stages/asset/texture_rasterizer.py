"""Rasterization of a mesh onto its texture: vertex frames interpolated at each pixel."""

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, Mesh

_SLACK = 1e-4  # px and barycentric coordinates by which a pixel may miss a triangle, so that none falls between two


def rasterize_frames(mesh: Mesh, height: int, width: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Interpolate a mesh's normals (3) and tangents (4) at the N pixels that it covers in its texture (H, W).

    Returns them as (N, 7), and the mask (H, W) of covered pixels. Triangles that face away from the camera (walls and
    back) are left out. Where several triangles cover a pixel, the last one is used.
    """
    place = mesh.uv * np.array([width, height]) - 0.5
    corner = place[mesh.faces]  # (F, 3, 2) x, y [px]
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    facing = np.flatnonzero(area < 0)  # v runs down
    corner, one, two, area = corner[facing], one[facing], two[facing], area[facing]
    first = np.ceil(corner.min(axis=1) - _SLACK).astype(np.int32)
    extent = np.floor(corner.max(axis=1) + _SLACK).astype(np.int32) - first
    at = (first - corner[:, 0]).astype(np.float32)
    across, down = ((v / area[:, None]).astype(np.float32) for v in (one, two))
    # barycentric coordinates of the second and third corner at the first pixel; they are linear in the pixel
    second = at[:, 0] * down[:, 1] - at[:, 1] * down[:, 0]
    third = across[:, 0] * at[:, 1] - across[:, 1] * at[:, 0]
    owner = np.full(height * width, -1, np.int32)
    weights = np.empty((height * width, 2), np.float32)
    for y in range(int(extent[:, 1].max(initial=-1)) + 1):
        tall = np.flatnonzero(extent[:, 1] >= y)
        for x in range(int(extent[tall, 0].max(initial=-1)) + 1):
            f = tall[extent[tall, 0] >= x]
            w1 = second[f] + (x * down[f, 1] - y * down[f, 0])
            w2 = third[f] + (y * across[f, 0] - x * across[f, 1])
            hit = (w1 > -_SLACK) & (w2 > -_SLACK) & (w1 + w2 < 1 + _SLACK)
            f = f[hit]
            pixel = (first[f, 1] + y) * width + first[f, 0] + x
            owner[pixel] = f
            weights[pixel, 0], weights[pixel, 1] = w1[hit], w2[hit]
    covered = owner >= 0
    corners = mesh.faces[facing][owner[covered]]  # (N, 3)
    w1, w2 = weights[covered].T[..., None]
    value = np.concatenate([mesh.normals, mesh.tangents], axis=-1, dtype=np.float32)
    out = value[corners[:, 0]] * (1 - w1 - w2)
    out += value[corners[:, 1]] * w1
    out += value[corners[:, 2]] * w2
    return out, covered.reshape(height, width)
