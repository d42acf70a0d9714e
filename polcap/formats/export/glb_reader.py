"""In: a GLB with PNG textures that `gltf.write` made. Out: its asset again, bit for bit, and the PNGs' bytes.

It stands in for building mesh and textures from the maps, so whoever reads it makes sure by digests that the file
is the one that was made from them.
"""

import json
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.formats.maps import png
from polcap.formats.raw import file_bytes, worker
from polcap.images import Asset, Mesh

_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_PICTURES = ("basecolor", "orm", "normal", "specular")  # in the order of the material
_Number = Annotated[int, Meta(ge=0, le=1 << 32)]


class _View(Struct, frozen=True):
    byteOffset: _Number
    byteLength: _Number


class _Accessor(Struct, frozen=True):
    bufferView: _Number
    count: _Number
    type: str


class _Document(Struct, frozen=True):
    """What is read of the JSON chunk; `gltf.encode` numbers accessors and pictures in one order."""

    accessors: Annotated[list[_Accessor], Meta(min_length=5, max_length=5)]
    bufferViews: Annotated[list[_View], Meta(min_length=9, max_length=9)]
    asset: dict[str, Any]
    materials: Annotated[list[dict[str, Any]], Meta(min_length=1, max_length=1)]


class _Extras(Struct, frozen=True):
    unit: str
    origin_in_camera: tuple[float, float, float]
    pieces: int
    cuts: float
    cut_px: float
    raggedness: float


@dataclass(frozen=True)
class Stored:
    """An asset as a GLB holds it."""

    asset: Asset
    pngs: dict[str, bytes]  # by the keys of `gltf.textures`


def read(path: Path, digest: str, ours: bool = False) -> Stored:
    """The asset of the GLB whose bytes have this digest; its depth map is empty, for no GLB holds one.

    A file that is known as `ours`, untouched since, needs no child process to be parsed.

    Raises
    ------
    DecodeError
        The file is missing, has other bytes, or is not as `gltf.write` makes it.
    """
    facts, arrays = decode(str(path), digest) if ours else worker.call(decode, path, digest=digest)
    extras = msgspec.convert(facts["extras"], _Extras)
    points = arrays["points"].astype(np.float64) + np.array(extras.origin_in_camera)
    mesh = Mesh(
        vertices=points.astype(np.float32),
        normals=arrays["normals"],
        uv=arrays["uv"],
        tangents=arrays["tangents"],
        faces=arrays["faces"],
        depth=np.zeros((0, 0), np.float32),
        metric=extras.unit == "metre",
        pieces=extras.pieces,
        cuts=extras.cuts,
        cut_px=extras.cut_px,
        raggedness=extras.raggedness,
    )
    red, green, blue = (float(one) for one in facts["factor"])
    asset = Asset(
        mesh=mesh,
        base_color=arrays["basecolor"],
        occlusion_roughness_metallic=arrays["orm"],
        normal=arrays["normal"],
        specular_color=arrays["specular"],
        specular_factor=(red, green, blue),
        ior=float(facts["ior"]),
    )
    return Stored(asset, {key: arrays[f"{key}.png"].tobytes() for key in _PICTURES})


def decode(path: str, digest: str) -> worker.Answer:
    """What `read` reads; raises DecodeError."""
    data = file_bytes.load(path, digest)
    try:
        return _parsed(path, data)
    except (struct.error, ValueError, LookupError, TypeError, cv2.error) as error:
        raise DecodeError(f"{path} is not as polcap wrote it ({error}); export again") from error


def _parsed(path: str, data: bytes) -> worker.Answer:
    length = struct.unpack_from("<I", data, 12)[0]
    said = msgspec.convert(json.loads(data[20 : 20 + length]), _Document)
    blob = memoryview(data)[28 + length :]
    extras = msgspec.to_builtins(msgspec.convert(said.asset["extras"], _Extras))
    parts = [blob[one.byteOffset : one.byteOffset + one.byteLength] for one in said.bufferViews]
    points, normals, tangents, uv = (_array(one, parts, np.float32) for one in said.accessors[:4])
    faces = _array(said.accessors[4], parts, np.uint32)
    if not all(np.isfinite(one).all() and len(one) == len(points) for one in (points, normals, tangents, uv)):
        raise ValueError("a vertex is no number")
    if len(points) >= 1 << 31 or faces.max(initial=0) >= len(points):
        raise ValueError("a triangle has no such vertex")
    arrays = {"points": points, "normals": normals, "tangents": tangents, "uv": uv}
    arrays["faces"] = faces.astype(np.int32).reshape(-1, 3)
    with ThreadPoolExecutor(len(_PICTURES)) as pool:
        pictures = pool.map(partial(png.pixels, path), map(bytes, parts[5:]))
        arrays |= zip(_PICTURES, pictures)
    arrays |= {f"{key}.png": np.frombuffer(part, np.uint8) for key, part in zip(_PICTURES, parts[5:])}
    material = said.materials[0]["extensions"]
    factor = material["KHR_materials_specular"]["specularColorFactor"]
    return {"extras": extras, "factor": factor, "ior": material["KHR_materials_ior"]["ior"]}, arrays


def _array(of: _Accessor, parts: list[memoryview], kind: type[np.generic]) -> NDArray[Any]:
    size = _SIZES[of.type]
    found = np.frombuffer(parts[of.bufferView], kind)
    return found.reshape(of.count, size) if size > 1 else found.reshape(of.count)
