"""Benchmark of GLB size: bytes of a result with each kind of geometry, and the normal error that it causes.

python tests/benchmarks/bench_glb.py RESULT     (DracoPy for `draco`)

`texture` compares the normals that a renderer computes at each pixel (vertex frames interpolated, times the normal
texture) with those of the maps; `float` compares them with those of the first row.
"""

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polcap.config import Config
from polcap.formats.export import gltf
from polcap.image_values import Floats
from polcap.mesh_values import Asset, Mesh
from polcap.optics import frames
from polcap.optics.texture_rasterizer import rasterize_frames
from polcap.pipeline import detail_levels, export_request
from polcap.pipeline.export_request import ExportRequest

CASES = {
    "float": ExportRequest(formats=("gltf",), geometry="float"),
    "quantized": ExportRequest(formats=("gltf",), geometry="quantized"),
    "draco": ExportRequest(formats=("gltf",), geometry="draco"),
    "engines": ExportRequest(formats=("gltf",), triangles=20_000),
    "web": ExportRequest(preset="web"),
    "web, draco": ExportRequest(preset="web", geometry="draco"),
}
COMPONENT: dict[int, Any] = {5120: np.int8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}


def main(folder: Path) -> None:
    source = detail_levels.read(folder / "maps", Config())
    maps = source.maps
    print(f"{'case':12}{'MB':>7}{'triangles':>11}{'texture: median, 95 %':>24}{'float: median, 99 %':>22}")
    first = None
    for name, wanted in CASES.items():
        asset = detail_levels.levels(source, wanted)[0].asset
        preset = export_request.effective(wanted)
        data = gltf.encode(asset, "asset", gltf.GlbOptions("webp", preset.geometry))
        seen = rendered(read(data, asset.mesh), asset)
        first = seen if first is None else first
        inside = maps.mask & np.isfinite(seen[..., 0]) & np.isfinite(first[..., 0])
        map_error, float_error = (degrees(seen, other)[inside] for other in (maps.normal, first))
        figures = [*np.percentile(map_error, [50, 95]), *np.percentile(float_error, [50, 99])]
        print(f"{name:12}{len(data) / 1e6:7.2f}{len(asset.mesh.faces):11}" + "".join(f"{x:11.3f}°" for x in figures))


def read(data: bytes, mesh: Mesh) -> Mesh:
    """The mesh with the frames, texture coordinates and faces that a GLB holds."""
    (length,) = struct.unpack_from("<I", data, 12)
    said, chunk = json.loads(data[20 : 20 + length]), data[28 + length :]

    def view(number: int) -> bytes:
        start = said["bufferViews"][number]["byteOffset"]
        return chunk[start : start + said["bufferViews"][number]["byteLength"]]

    def array(number: int) -> Any:
        about = said["accessors"][number]
        kind: np.dtype[Any] = np.dtype(COMPONENT[about["componentType"]])
        width = 1 if about["type"] == "SCALAR" else int(about["type"][3:])
        values = np.frombuffer(view(about["bufferView"]), kind).reshape(about["count"], -1)[:, :width]
        return values / np.iinfo(kind).max if about.get("normalized") else values

    primitive = said["meshes"][0]["primitives"][0]
    packed = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    names = ("NORMAL", "TANGENT", "TEXCOORD_0")
    if packed:
        import DracoPy

        decoded = DracoPy.decode(view(packed["bufferView"]))
        values = {one["unique_id"]: one["data"] for one in decoded.attributes}
        normal, tangent, uv = (values[packed["attributes"][name]] for name in names)
        tangent, faces = tangent / 127, decoded.faces
    else:
        normal, tangent, uv = (array(primitive["attributes"][name]) for name in names)
        faces = array(primitive["indices"])
    return replace(
        mesh,
        normals=np.asarray(normal, np.float32),
        tangents=np.asarray(tangent, np.float32),
        uv=np.asarray(uv, np.float32),
        faces=faces.reshape(-1, 3).astype(np.int32),
    )


def rendered(mesh: Mesh, asset: Asset) -> Floats:
    """Normals (H, W, 3) of a renderer; NaN where no triangle is."""
    frame, covered = rasterize_frames(mesh, *asset.normal.shape[:2])
    texture = cv2.resize(asset.normal, covered.shape[::-1])[covered] / np.float32(127.5) - 1
    n, t = frames.unit(frame[:, :3]), frames.unit(frame[:, 3:6])
    out = np.full((*covered.shape, 3), np.nan, np.float32)
    out[covered] = frames.unit(texture[:, :1] * t + texture[:, 1:2] * frames.cross(n, t) + texture[:, 2:] * n)
    return out


def degrees(one: Floats, two: Floats) -> Floats:
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(one - two, axis=-1) / 2, 0, 1))))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
