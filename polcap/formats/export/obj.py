"""Writes OBJ and MTL, with two EXR textures, for programs that read no glTF.

The material has keys for old readers (Kd, Ks, Ns, Ni) and new ones (Pr, Pm, norm). MTL cannot state a color space,
and Blender takes every 8- or 16-bit picture of an MTL for sRGB. So data (roughness, and the normals under map_Bump,
where Blender looks for them) are written as EXR, which every program reads unchanged; `norm` names the PNG for the
other programs. OBJ counts v upwards, glTF downwards.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from polcap.formats import atomic
from polcap.formats.export import gltf, texture_set
from polcap.formats.export.texture_set import SPECULAR_RANGE, Key
from polcap.mesh_values import Asset

_ROWS = 10_000  # of a table, formatted at a time


def stem(name: str) -> str:
    """File name without spaces, which OBJ and MTL cannot quote, and without #, %, @ and brackets.

    Web viewers take the names of textures for addresses, USD takes brackets and @ for packages.
    """
    return re.sub(r"[\s#%@\[\]]+", "_", name)


def write(
    path: Path, asset: Asset, name: str, files: Mapping[Key, str], comment: str = "", entry: Mapping[str, str] = {}
) -> list[Path]:
    """Write a mesh as `path` (.obj), its .mtl and two EXR textures; returns the paths.

    `files` are the names of the PNG textures in the same folder, by kind. `comment` is for OBJ and MTL, the catalog
    `entry` for the EXRs.
    """
    base = stem(path.stem)
    written = [path, *(path.with_name(f"{base}{ending}") for ending in (".mtl", "_roughness.exr", "_normal.exr"))]
    _, library, roughness, normal = written
    texture_set.write_exr(normal, texture_set.normal(asset), entry)
    texture_set.write_exr(roughness, texture_set.roughness(asset), entry)
    data: dict[Key, str] = {"roughness": roughness.name, "normal": normal.name}
    header = "".join(f"# {line}\n" for line in comment.splitlines())
    atomic.write(library, header + _material(asset, stem(name), files, data))
    with atomic.path(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode())
        _geometry(file, asset, stem(name), library.name)
    return written


def _geometry(file: IO[bytes], asset: Asset, material: str, library: str) -> None:
    """Write the mesh of an OBJ file: vertices, texture coordinates, normals, and faces with one index for all."""
    mesh = asset.mesh
    file.write(f"mtllib {library}\no {material}\n".encode())
    _table(file, "v %.8f %.8f %.8f\n", mesh.vertices - gltf.center(mesh.vertices))
    _table(file, "vt %.8f %.8f\n", mesh.uv * [1.0, -1.0] + [0.0, 1.0])
    _table(file, "vn %.6f %.6f %.6f\n", mesh.normals)
    file.write(f"usemtl {material}\ns 1\n".encode())
    _table(file, "f" + 3 * " %d/%d/%d" + "\n", np.repeat(mesh.faces + 1, 3, axis=1))


def _table(file: IO[bytes], line: str, values: NDArray[Any]) -> None:
    """Write a table (N, k) as text; `line` is the format of a row. Takes a third of the time of `np.savetxt`."""
    for rows in np.array_split(values, len(values) // _ROWS + 1):
        file.write((line * len(rows) % tuple(rows.ravel().tolist())).encode())


def _material(asset: Asset, material: str, files: Mapping[Key, str], data: Mapping[Key, str]) -> str:
    """Text of the .mtl. Ns, 0 to 1000, is the Blinn exponent 2/α² − 2 of the median roughness; Ks · map_Ks is F0."""
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
