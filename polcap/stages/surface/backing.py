"""What closes the mesh behind the side that the camera saw: nothing, walls, or walls and a flat back."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.stages.surface import boundary

Back = Literal["open", "skirt", "closed"]
_BEHIND = 0.02  # the back's distance behind the deepest vertex, over the object's depth and width


def closed(
    vertices: Floats, normals: Floats, uv: Floats, tangents: Floats, faces: NDArray[np.int32], back: Back
) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.int32]]:
    """The mesh with walls from its boundary straight back to a plane, and with `closed` that plane too.

    What is added takes its color from the front it hangs on; it was not photographed.

    Parameters
    ----------
    vertices, normals
        (V, 3), the camera at +z.
    uv
        (V, 2).
    tangents
        (V, 4), as glTF has them.
    faces
        (F, 3), counter-clockwise from outside.
    back
        "skirt": walls alone; "closed": the plane too.

    Returns
    -------
    tuple
        vertices, normals, uv, tangents and faces of all.
    """
    count = len(vertices)
    rim = boundary.edges(faces)
    extent = np.ptp(vertices, axis=0).max()
    floor = vertices[:, 2].min() - _BEHIND * extent
    behind = vertices.copy()
    behind[:, 2] = floor
    start, end = rim.T
    wall = np.concatenate([np.stack([end, start, start + count], -1), np.stack([end, start + count, end + count], -1)])
    added = [wall] if back == "skirt" else [wall, faces[:, ::-1] + count]
    parts = np.concatenate([faces, *added])
    away = np.where(back == "closed", [0.0, 0.0, -1.0], normals)
    used, renamed = np.unique(parts, return_inverse=True)
    every = (
        np.concatenate([vertices, behind]),
        np.concatenate([normals, np.broadcast_to(away, normals.shape)]),
        np.concatenate([uv, uv]),
        np.concatenate([tangents, np.broadcast_to([1.0, 0.0, 0.0, 1.0], tangents.shape)]),
    )
    points, turned, place, frame = (values[used] for values in every)
    return points, turned, place, frame, renamed.reshape(-1, 3).astype(np.int32)
