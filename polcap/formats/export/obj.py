"""Writes OBJ and MTL, with two EXR textures, for programs that read no glTF.

The material has keys for old readers (Kd, Ks, Ns, Ni) and new ones (Pr, Pm, norm). MTL cannot state a color space,
and Blender takes every 8- or 16-bit picture of an MTL for sRGB. So data (roughness, and the normals under map_Bump,
where Blender looks for them) are written as EXR, which every program reads unchanged; `norm` names the PNG for the
other programs. OBJ counts v upwards, glTF downwards.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.formats import atomic
from polcap.formats.export import gltf
from polcap.formats.export.texture_set import SPECULAR_RANGE, Key
from polcap.formats.maps import exr
from polcap.images import Asset, Floats


def stem(name: str) -> str:
    """A name without spaces: OBJ and MTL have no quotes."""
    return re.sub(r"\s+", "_", name)


def write(path: Path, asset: Asset, name: str, files: Mapping[Key, str], comment: str = "") -> list[Path]:
    """Write `path` (.obj), its .mtl and two EXRs, and return their paths; `files` name the PNGs in the same folder.

    Raises
    ------
    StorageError
        A file cannot be written.
    """
    base = stem(path.stem)
    written = [path, *(path.with_name(f"{base}{ending}") for ending in (".mtl", "_roughness.exr", "_normal.exr"))]
    _, library, roughness, normal = written
    _data(normal, {c: asset.normal[..., k] for k, c in enumerate("RGB")})
    _data(roughness, {"Y": np.ascontiguousarray(asset.occlusion_roughness_metallic[..., 1])})
    data: dict[Key, str] = {"roughness": roughness.name, "normal": normal.name}
    header = "".join(f"# {line}\n" for line in comment.splitlines())
    with atomic.path(library) as temporary:
        temporary.write_text(header + _material(asset, stem(name), files, data), encoding="utf-8")
    with atomic.path(path) as temporary:
        temporary.write_bytes(header.encode() + _geometry(asset, stem(name), library.name))
    return written


def _data(file: Path, channels: Mapping[str, NDArray[Any]]) -> None:
    """Write integers as the share of their greatest value, in half."""
    exr.write(file, {name: one / np.float32(np.iinfo(one.dtype).max) for name, one in channels.items()}, half=True)


def _geometry(asset: Asset, material: str, library: str) -> bytes:
    """The text of the mesh. Numbers have leading zeros, so that whole columns are written at once."""
    mesh = asset.mesh
    head = f"mtllib {library}\no {material}\n".encode()
    vertices = _decimals(b"v", mesh.vertices - gltf.center(mesh.vertices), 8)
    corners = _decimals(b"vt", mesh.uv * [1.0, -1.0] + [0.0, 1.0], 8)
    normals = _decimals(b"vn", mesh.normals, 6)
    return b"".join([head, vertices, corners, normals, f"usemtl {material}\ns 1\n".encode(), _faces(mesh.faces)])


def _decimals(word: bytes, values: Floats, places: int) -> bytes:
    """One line for each row of (N, k) numbers, with `places` decimals."""
    count, columns = values.shape
    if not count:
        return b""
    left = np.rint(np.abs(values, dtype=np.float64) * 10**places).astype(np.uint64)
    digits = max(len(str(int(left.max()))), places + 1)
    width = 2 + digits + 1  # a space, the sign, the digits and the point
    out = np.full((count, columns, width), ord(" "), np.uint8)
    out[..., 1] = np.where(np.signbit(values) & (left > 0), ord("-"), ord("0"))
    _digits(out[..., 2 : 2 + digits - places], left // np.uint64(10**places))
    out[..., 2 + digits - places] = ord(".")
    _digits(out[..., 3 + digits - places :], left % np.uint64(10**places))
    return _lines(word, out.reshape(count, columns * width))


def _faces(faces: NDArray[np.int32]) -> bytes:
    """Lines f a/a/a b/b/b c/c/c: vertex, texture corner and normal share a number, from 1."""
    if not len(faces):
        return b""
    number = faces.astype(np.uint64) + np.uint64(1)
    digits = len(str(int(number.max())))
    out = np.full((len(faces), 3, 3, digits + 1), ord("/"), np.uint8)
    out[:, :, 0, 0] = ord(" ")
    _digits(out[:, :, 0, 1:], number)
    out[:, :, 1:, 1:] = out[:, :, :1, 1:]
    return _lines(b"f", out.reshape(len(faces), -1))


def _digits(out: NDArray[np.uint8], number: NDArray[np.uint64]) -> None:
    """Write the decimal digits of whole numbers into the last axis, from its end."""
    left = number.astype(np.uint32) if number.max() < 2**32 else number
    ten = left.dtype.type(10)
    for place in range(out.shape[-1] - 1, -1, -1):
        left, digit = np.divmod(left, ten)
        out[..., place] = digit + left.dtype.type(ord("0"))


def _lines(word: bytes, text: NDArray[np.uint8]) -> bytes:
    start = np.broadcast_to(np.frombuffer(word, np.uint8), (len(text), len(word)))
    end = np.full((len(text), 1), ord("\n"), np.uint8)
    return np.concatenate([start, text, end], axis=1).tobytes()


def _material(asset: Asset, material: str, files: Mapping[Key, str], data: Mapping[Key, str]) -> str:
    """The .mtl; Ns is the Blinn exponent 2/α² − 2 of the median roughness, Ks · map_Ks is F0."""
    packed = asset.occlusion_roughness_metallic
    alpha = float(np.median(packed[..., 1]) / np.iinfo(packed.dtype).max) ** 2
    exponent = min(max(2 / max(alpha, 1e-3) ** 2 - 2, 0.0), 1000.0)
    lines = [
        f"newmtl {material}",
        "illum 2",
        "Ka 0 0 0",
        "Kd 1 1 1",
        f"map_Kd {files['basecolor']}",
        f"Ks {SPECULAR_RANGE:g} {SPECULAR_RANGE:g} {SPECULAR_RANGE:g}",
        f"map_Ks {files['specular']}",
        f"Ns {exponent:.6g}",
        f"Ni {asset.ior:.6g}",
        "Pr 1",
        f"map_Pr {data['roughness']}",
        "Pm 0",
        f"map_Bump -bm 1 {data['normal']}",
        f"norm {files['normal']}",
    ]
    return "\n".join(lines) + "\n"
