"""In: a file of triangles, of any kind that trimesh reads or polcap's compact .npz. Out: vertices and faces."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.images import Floats


def read(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3), in the file's own unit and axes, and faces (F, 3).

    An .npz holds `vq` uint16 (V, 3), position = vq/65535·vscale + vmin, and `faces`. Of a scene of
    several meshes all are taken, each in its place.

    Raises
    ------
    DecodeError
        The file is missing, of an unknown kind, damaged, or holds no triangle.
    """
    try:
        vertices, faces = _compact(path) if path.suffix == ".npz" else _any(path)
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror or error}; check the path") from error
    except Exception as error:  # each of trimesh's readers fails in its own way
        raise DecodeError(f"{path} is no mesh that can be read ({error}); give a PLY, OBJ, STL or GLB") from error
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise DecodeError(f"{path} holds {len(faces)} usable triangles; give a mesh with faces")
    return vertices, faces


def _compact(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    with np.load(path) as data:
        return data["vq"].astype(np.float64) / 65535 * data["vscale"] + data["vmin"], data["faces"].astype(np.int64)


def _any(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    import trimesh

    found = trimesh.load(path, force="mesh", process=False)
    return np.asarray(found.vertices, dtype=np.float64), np.asarray(found.faces, dtype=np.int64)
