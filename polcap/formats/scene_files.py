"""Reads meshes and texture sets of other people, for synthetic scenes and training."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.image_values import Floats
from polcap.optics import color
from polcap.optics.resize import area_mean


def read_mesh(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """Read a triangle mesh: vertices (V, 3), in the file's unit and axes, and faces (F, 3).

    An .npz has `faces` and `vq` uint16 (V, 3), with position = vq/65535·vscale + vmin. If a file has several meshes,
    all are read, each at its position.

    Raises DecodeError: the file is missing, of an unknown format, damaged, or holds no triangle.
    """
    if not path.is_file():
        raise DecodeError(f"{path}: no such file; give a mesh as PLY, OBJ, STL or GLB")
    try:
        vertices, faces = _read_quantized(path) if path.suffix == ".npz" else _read_by_trimesh(path)
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror or error}; check the path") from error
    except Exception as error:  # each of trimesh's readers raises errors of its own
        raise DecodeError(f"{path} cannot be read as a mesh ({error}); give a PLY, OBJ, STL or GLB") from error
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise DecodeError(f"{path} holds {len(faces)} usable triangles; give a mesh with faces")
    return vertices, faces


def _read_quantized(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    with np.load(path) as data:
        return data["vq"].astype(np.float64) / 65535 * data["vscale"] + data["vmin"], data["faces"].astype(np.int64)


def _read_by_trimesh(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    import trimesh

    found = trimesh.load(path, force="mesh", process=False)
    return np.asarray(found.vertices, dtype=np.float64), np.asarray(found.faces, dtype=np.int64)


def read_textures(folder: Path, side: int = 256) -> Floats:
    """Read a texture set: linear albedo (3), roughness, and relief slopes along columns and rows, (6, side, side).

    albedo.jpg (sRGB) and roughness.jpg are required; normal.jpg (tangent space, green down as in DirectX) or height.jpg
    is optional. Raises DecodeError: a picture is missing or cannot be read.
    """
    albedo = _picture(folder / "albedo.jpg", side)[..., ::-1]
    linear = color.decode_srgb(albedo)
    rough = _picture(folder / "roughness.jpg", side).mean(axis=-1)
    slope: Floats = np.zeros((side, side, 2), dtype=np.float32)
    if (folder / "normal.jpg").exists():
        normal = _picture(folder / "normal.jpg", side)[..., ::-1] * 2 - 1
        slope = -normal[..., :2] / np.maximum(normal[..., 2:], 0.3)  # finite at grazing normals
    elif (folder / "height.jpg").exists():
        height = _picture(folder / "height.jpg", side).mean(axis=-1)  # white is a 32nd of the side high
        slope = np.stack([np.roll(height, -1, a) - np.roll(height, 1, a) for a in (1, 0)], axis=-1) * side / 64
    maps = np.concatenate([linear, rough[..., None], np.clip(slope, -2, 2)], axis=-1)  # steeper slopes are clipped
    return np.ascontiguousarray(maps.transpose(2, 0, 1), dtype=np.float32)


def read_height(path: Path, side: int) -> Floats:
    """Read a height map, (side, side), 0…1: the gray of a picture of 8 or 16 bits. Raises DecodeError."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) if path.is_file() else None
    if image is None:
        raise DecodeError(f"{path} is missing or not a picture; give a height map as PNG, white is high")
    gray = image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    method = cv2.INTER_AREA if min(image.shape) >= side else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(gray, (side, side), interpolation=method))


def _picture(path: Path, side: int) -> Floats:
    """A picture of a texture set, (side, side, 3) in 0…1. Raises DecodeError: it is missing."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None  # OpenCV would print a warning
    if image is None:
        raise DecodeError(f"{path} is missing or not a picture; a texture set has an albedo.jpg and a roughness.jpg")
    return area_mean(image, (side, side)).astype(np.float32) / 255
