"""In: an Asset. Out: NAME.obj, NAME.mtl and the two EXRs that only they name, for programs that read no glTF.

The material is written for readers old (Kd, Ks, Ns, Ni) and new (Pr, Pm, norm). MTL has no word for
colour space. Blender takes every 8- or 16-bit picture of an MTL for sRGB, so what is data (roughness,
and the normals under map_Bump, which is where Blender looks for them) goes out as EXR, which everyone
reads as it is; `norm` names the PNG for the others. OBJ counts v upwards where glTF counts it down.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh

from polcap.formats import atomic, exr, gltf
from polcap.formats.texture_set import SPECULAR_RANGE, Key
from polcap.images import Asset


def stem(name: str) -> str:
    """A name as OBJ and MTL take it, which know no quotes."""
    return re.sub(r"\s+", "_", name)


def write(path: Path, asset: Asset, name: str, files: Mapping[Key, str], says: str = "") -> list[Path]:
    """Write `path` (.obj) and beside it the .mtl and two EXRs; `files` names the PNGs beside them.

    Returns
    -------
    The files written.

    Raises
    ------
    StorageError
        A file cannot be written.
    """
    base = stem(path.stem)
    written = [path, *(path.with_name(f"{base}{ending}") for ending in (".mtl", "_roughness.exr", "_normal.exr"))]
    _, library, roughness, normal = written
    whole = np.float32(np.iinfo(asset.normal.dtype).max)
    exr.write(normal, {c: asset.normal[..., k] / whole for k, c in enumerate("RGB")}, half=True)
    packed = asset.occlusion_roughness_metallic
    exr.write(roughness, {"Y": packed[..., 1] / np.float32(np.iinfo(packed.dtype).max)}, half=True)
    data: dict[Key, str] = {"roughness": roughness.name, "normal": normal.name}
    header = "".join(f"# {line}\n" for line in says.splitlines())
    with atomic.path(library) as temporary:
        temporary.write_text(header + _material(asset, stem(name), files, data), encoding="utf-8")
    with atomic.path(path) as temporary:
        temporary.write_text(header + _geometry(asset, stem(name), library.name), encoding="utf-8")
    return written


def _geometry(asset: Asset, material: str, library: str) -> str:
    mesh = asset.mesh
    shape = trimesh.Trimesh(
        vertices=mesh.vertices - gltf.center(mesh.vertices),
        faces=mesh.faces,
        vertex_normals=mesh.normals,
        visual=trimesh.visual.TextureVisuals(
            uv=mesh.uv * [1.0, -1.0] + [0.0, 1.0], material=trimesh.visual.material.SimpleMaterial()
        ),
        process=False,
    )
    text = trimesh.exchange.obj.export_obj(
        shape, include_normals=True, include_color=False, write_texture=False, mtl_name=library, header=material
    )
    return re.sub(r"(?m)^usemtl .*$", f"usemtl {material}", text, count=1)


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
