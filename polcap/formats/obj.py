"""In: an Asset. Out: NAME.obj, NAME.mtl and their textures, for programs that read no glTF.

The material is written for readers old (Kd, Ks, Ns, Ni) and new (Pr, Pm, norm). OBJ counts v upwards
where glTF counts it down.
"""

import re
from pathlib import Path

import numpy as np
import trimesh

from polcap.formats import atomic, gltf, png
from polcap.images import Asset


def write(path: Path, asset: Asset, name: str) -> None:
    """Write `path` (.obj) and beside it the .mtl and four PNGs that it names.

    Raises
    ------
    StorageError
        A file cannot be written.
    """
    path = Path(path)
    stem = re.sub(r"\s+", "_", path.stem)  # the formats know no quotes
    material = re.sub(r"\s+", "_", name)
    textures = {
        "basecolor": asset.base_color,
        "roughness": asset.occlusion_roughness_metallic[..., 1],
        "normal": asset.normal,
        "specular": asset.specular_color,
    }
    for key, pixels in textures.items():
        png.write(path.with_name(f"{stem}_{key}.png"), pixels)
    with atomic.path(path.with_name(f"{stem}.mtl")) as temporary:
        temporary.write_text(_material(asset, material, stem), encoding="utf-8")
    with atomic.path(path) as temporary:
        temporary.write_text(_geometry(asset, material, f"{stem}.mtl"), encoding="utf-8")


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


def _material(asset: Asset, material: str, stem: str) -> str:
    """The .mtl; Ns is the Blinn exponent 2/α² − 2 of the median roughness."""
    alpha = float(np.median(asset.occlusion_roughness_metallic[..., 1]) / 255) ** 2
    exponent = min(max(2 / max(alpha, 1e-3) ** 2 - 2, 0.0), 1000.0)
    specular = [factor * ((asset.ior - 1) / (asset.ior + 1)) ** 2 for factor in asset.specular_factor]
    lines = [
        f"newmtl {material}",
        "illum 2",
        "Ka 0 0 0",
        "Kd 1 1 1",
        f"map_Kd {stem}_basecolor.png",
        "Ks " + " ".join(f"{value:.6g}" for value in specular),
        f"map_Ks {stem}_specular.png",
        f"Ns {exponent:.6g}",
        f"Ni {asset.ior:.6g}",
        "Pr 1",
        f"map_Pr {stem}_roughness.png",
        "Pm 0",
        f"norm {stem}_normal.png",
    ]
    return "\n".join(lines) + "\n"
