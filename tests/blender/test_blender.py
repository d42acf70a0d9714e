"""Blender loads GLB, OBJ and USD: what it samples is what the maps say, upright and of the right size."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polcap.formats.export import encoders, gltf, obj, texture_set, usd
from polcap.formats.export.glb_geometry import Geometry
from polcap.image_values import Floats
from polcap.mesh_values import ReliefMesh
from polcap.pipeline import run as pipeline
from polcap.pipeline.export_request import ExportRequest
from polcap.stage_values import SurfaceMaps
from tests import surfaces
from tests.blender import session
from tests.conftest import ROOT

PACKED: tuple[Geometry, ...] = ("quantized", "draco") if importlib.util.find_spec("DracoPy") else ("quantized",)
CASES = (".glb", ".obj", ".usdc", *(f"_{geometry}.glb" for geometry in PACKED))
SIZE = (surfaces.WIDTH, surfaces.HEIGHT)

Answers = dict[str, dict[str, Floats]]


@pytest.fixture(scope="module")
def maps() -> SurfaceMaps:
    """The ball with roughness and F0 that vary, ripples in its normals."""
    column, row = np.meshgrid(np.arange(surfaces.WIDTH), np.arange(surfaces.HEIGHT))
    made = surfaces.maps(ripple=0.1)
    specular = 0.02 + 0.05 * column / surfaces.WIDTH
    return replace(
        made,
        roughness=(0.2 + 0.6 * row / surfaces.HEIGHT).astype(np.float32),
        specular=np.repeat(specular[..., None], 3, axis=-1).astype(np.float32),
    )


@pytest.fixture(scope="module")
def mesh() -> ReliefMesh:
    return surfaces.mesh(surfaces.maps())


@pytest.fixture(scope="module")
def answers(maps: SurfaceMaps, mesh: ReliefMesh, tmp_path_factory: pytest.TempPathFactory) -> Answers:
    session.require()
    pytest.importorskip("pxr", reason="needs usd-core")
    folder, built = tmp_path_factory.mktemp("blender"), surfaces.built(maps, mesh)
    files: dict[texture_set.Key, str] = {key: f"ball_{key}.png" for key in texture_set.LOOSE}
    for key, file in files.items():
        (folder / file).write_bytes(encoders.encode(texture_set.LOOSE[key](built), "png"))
    (folder / "ball.glb").write_bytes(gltf.encode(built, "ball"))
    for geometry in PACKED:
        (folder / f"ball_{geometry}.glb").write_bytes(gltf.encode(built, "ball", gltf.GlbOptions(geometry=geometry)))
    obj.write(folder / "ball.obj", built, "ball", files)
    usd.write(folder / "ball.usdc", built, "ball", files, {})
    found = session.ask(folder, [folder / f"ball{ending}" for ending in CASES], bake=SIZE)
    return dict(zip(CASES, found))


@pytest.mark.parametrize("case", CASES)
def test_upright_and_of_the_right_size(answers: Answers, mesh: ReliefMesh, case: str) -> None:
    seen = answers[case]["vertices"]
    truth = mesh.vertices - gltf.center(mesh.vertices)
    assert np.allclose([seen.min(0), seen.max(0)], [truth.min(0), truth.max(0)], atol=1e-5)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("what", ["Base Color", "Roughness", "F0"])
def test_material_is_that_of_the_maps(answers: Answers, maps: SurfaceMaps, case: str, what: str) -> None:
    """Base colour is ρ_d T₊(0)²/(1 − F0); mean within 2 %, every texel within what eight bits leave."""
    specular = maps.specular
    truth = {
        "Base Color": 0.9216 * maps.diffuse / (1 - specular.max(-1, keepdims=True)),
        "Roughness": maps.roughness[..., None].repeat(3, -1),
        "F0": specular,
    }[what]
    seen = answers[case][what]
    inside = (np.abs(seen).sum(-1) > 0) & maps.mask
    assert inside.sum() > 0.9 * maps.mask.sum()
    assert np.allclose(seen[inside].mean(0), truth[inside].mean(0), rtol=0.02)
    assert np.percentile(np.abs(seen - truth)[inside], 95) < 0.02 * truth[inside].max()


@pytest.mark.parametrize("case", CASES)
def test_normals_are_those_of_the_maps(answers: Answers, maps: SurfaceMaps, case: str) -> None:
    """Within what eight bits leave; Blender derives the tangents, of glTF's too."""
    seen = answers[case]["normal"]
    covered = answers[case]["Base Color"].sum(-1) > 0
    inside = covered & maps.mask & (maps.normal[..., 2] > 0.35)
    cosine = np.sum(seen * maps.normal, axis=-1)[inside] / np.linalg.norm(seen[inside], axis=-1)
    smooth = np.sum(maps.normal * surfaces.maps().normal, axis=-1)[inside]
    error, ripple = (np.degrees(np.arccos(np.clip(one, -1, 1))).mean() for one in (cosine, smooth))
    assert error < 0.5 and ripple > 4


def test_extension_is_a_package_that_blender_takes(tmp_path: Path) -> None:
    """Blender's own validator of extensions reads the manifest."""
    script = tmp_path / "validate.py"
    script.write_text(
        """
import runpy, sys
from pathlib import Path
import bpy
tool = next(Path(bpy.utils.system_resource("SCRIPTS")).rglob("blender_ext.py"))
sys.argv = [str(tool), "validate", sys.argv[1]]
runpy.run_path(str(tool), run_name="__main__")
"""
    )
    assert "Success" in session.run(script, ROOT / "examples" / "blender" / "polcap_result")


@pytest.mark.parametrize("upright_deg", [0, 90])
def test_extension_sets_up_camera_flash_and_photograph(copy: Path, tmp_path: Path, upright_deg: int) -> None:
    """The bundled result through its own camera: the rendered outline falls onto the mask."""
    about = json.loads((copy / "report.json").read_text())
    about["capture"]["upright_deg"] = upright_deg
    (copy / "report.json").write_text(json.dumps(about))
    pipeline.export(copy, ExportRequest())
    script = tmp_path / "load.py"
    script.write_text(
        f"""
import sys
sys.path.insert(0, {str(ROOT / "examples" / "blender")!r})
import bpy, numpy as np, polcap_result
bpy.ops.wm.read_factory_settings(use_empty=True)
polcap_result.register()
bpy.ops.import_scene.polcap(filepath=sys.argv[1])
scene = bpy.context.scene
scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 4, "CPU"
scene.cycles.use_denoising, scene.render.film_transparent = False, True
scene.render.image_settings.file_format, scene.render.filepath = "PNG", sys.argv[2]
bpy.ops.render.render(write_still=True)
mesh = next(one for one in bpy.data.objects if one.type == "MESH")
bpy.context.view_layer.objects.active = mesh
before = polcap_result.switchable(mesh).links[-1].to_socket.name
assert bpy.ops.material.polcap_confidence() == {{"FINISHED"}}
assert scene.camera.data.background_images[0].image.size[:] == (scene.render.resolution_x, scene.render.resolution_y)
assert mesh["polcap_unit"] == "relative" and "confidence" in bpy.context.view_layer.aovs
polcap_result.unregister()
"""
    )
    import cv2

    said = session.run(script, copy / "maps" / "maps.json", tmp_path / "seen.png")
    assert "scale is relative" in said
    seen, mask = (cv2.imread(str(file), -1) for file in (tmp_path / "seen.png", copy / "maps" / "mask.png"))
    assert seen is not None and mask is not None and seen.shape[:2] == mask.shape
    assert ((seen[..., 3] > 127) != (mask > 127)).sum() < 0.03 * (mask > 127).sum()
    photograph = cv2.imread(str(copy / "maps" / "photograph.png")).astype(float)
    inside = cv2.erode(mask, np.ones((9, 9))) > 127
    gain = [np.median(seen[..., k][inside]) / np.median(photograph[..., k][inside]) for k in range(3)]
    assert np.allclose(gain, 1, atol=0.1)  # the flash is as bright as the one of the photograph
