"""GLB and OBJ in three.js, through the photograph's own camera: the picture must fall onto the maps.

The ball's top-left quarter is red. Orientation, texture flip and normal direction are asserted
against the maps, not against what the writer believes.
"""

import importlib.util

import numpy as np
import pytest
from numpy.typing import NDArray

from polcap.formats.export import encoders, gltf, obj, texture_set
from polcap.formats.export.glb_geometry import Geometry
from polcap.image_values import Floats
from polcap.stage_values import SurfaceMaps
from tests import surfaces
from tests.render import browser

LIGHTS: dict[str, tuple[float, float, float] | None] = {
    "everywhere": None,
    "above": (0.0, 1.0, 0.4),
    "right": (1.0, 0.0, 0.4),
}
RIPPLED = surfaces.maps(ripple=0.15)
PACKED: tuple[Geometry, ...] = ("quantized", "draco") if importlib.util.find_spec("DracoPy") else ("quantized",)
CASES = [f"{shape}.{suffix}" for shape in ("ball", "plane") for suffix in ("glb", "obj")]
CASES += [f"{shape}_{geometry}.glb" for shape in ("ball", "plane") for geometry in PACKED]

Pictures = dict[str, dict[str, Floats]]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Pictures:
    """By case and light. The mesh is the smooth ball, or a plane; the maps are the rippled ball's."""
    browser.require()
    folder = tmp_path_factory.mktemp("render")
    jobs = []
    for shape, mesh in (("ball", surfaces.mesh(surfaces.maps())), ("plane", surfaces.flat_mesh(RIPPLED))):
        asset = surfaces.built(RIPPLED, mesh)
        (folder / f"{shape}.glb").write_bytes(gltf.encode(asset, shape))
        files = {key: f"{shape}_{key}.png" for key in texture_set.LOOSE}
        obj.write(folder / f"{shape}.obj", asset, shape, files)
        for key, file in files.items():
            (folder / file).write_bytes(encoders.encode(texture_set.LOOSE[key](asset), "png"))
        for geometry in PACKED:
            (folder / f"{shape}_{geometry}.glb").write_bytes(
                gltf.encode(asset, shape, gltf.GlbOptions(geometry=geometry))
            )
        for model in (folder / case for case in CASES if case.startswith(shape)):
            jobs.append(browser.Job(model.name, model, mesh, RIPPLED.view, tuple(LIGHTS.values())))
    answer = browser.render(folder, jobs)
    return {job.name: dict(zip(LIGHTS, answer[job.name])) for job in jobs}


def inner(maps: SurfaceMaps) -> NDArray[np.bool_]:
    """Pixels of the object that are not at its rim."""
    mask = maps.mask & (maps.normal[..., 2] > 0.35)
    return mask & np.roll(mask, 3, 0) & np.roll(mask, -3, 0) & np.roll(mask, 3, 1) & np.roll(mask, -3, 1)


@pytest.mark.parametrize("case", CASES)
def test_red_quarter_is_top_left_and_on_its_pixels(pictures: Pictures, case: str) -> None:
    seen, truth = pictures[case]["everywhere"], 0.96**2 * RIPPLED.diffuse
    red = seen[..., 0] > seen[..., 1]
    agree = red == (truth[..., 0] > truth[..., 1])
    assert agree[inner(RIPPLED)].mean() > 0.98  # the seam is one filtered pixel wide
    assert np.median(np.abs(seen - truth)[inner(RIPPLED)]) < 0.02


@pytest.mark.parametrize("case", CASES)
def test_object_fills_its_mask(pictures: Pictures, case: str) -> None:
    seen = pictures[case]["everywhere"].sum(axis=-1) > 0
    assert (seen != RIPPLED.mask).sum() < 0.03 * RIPPLED.mask.sum()  # half a pixel of the outline


@pytest.mark.parametrize("light", ["above", "right"])
@pytest.mark.parametrize("case", CASES)
def test_shading_is_that_of_the_maps(pictures: Pictures, case: str, light: str) -> None:
    to_light = LIGHTS[light]
    assert to_light is not None
    seen, truth = pictures[case][light], surfaces.lit(RIPPLED, np.array(to_light))
    plain = surfaces.lit(surfaces.maps(), np.array(to_light))
    inside = inner(RIPPLED)
    ripples, shown = (truth - plain)[inside].ravel(), (seen - plain)[inside].ravel()
    slope = (ripples @ shown) / (ripples @ ripples)
    error = np.sqrt(np.mean((seen - truth)[inside] ** 2))
    if case.endswith("glb"):
        assert error < 0.003 and abs(slope - 1) < 0.02
    else:  # OBJ has no tangents: three.js derives them, and squeezes them where the texture is not square
        assert error < 0.02 and abs(slope - 1) < 0.25
    half = np.nonzero(inside)[0 if light == "above" else 1]
    first = half < np.median(half)
    bright = seen[inside].sum(axis=-1) / truth.max()
    assert (bright[first].mean() > bright[~first].mean()) == (light == "above")
