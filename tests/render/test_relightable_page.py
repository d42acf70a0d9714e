"""The IIIF folder in a browser: a deep-zoom viewer finds every tile, and the page moves the light with the pointer."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from polcap.formats.export import iiif, openlime_page, relightable_layer
from polcap.optics import color, shade
from polcap.stages import asset
from tests import surfaces
from tests.render import devtools
from tests.render.devtools import served, visited

VIEWER = devtools.MODULES / "openseadragon" / "build" / "openseadragon" / "openseadragon.min.js"
TILES = """<!doctype html><meta charset="utf-8"><div id="view" style="width:900px;height:600px"></div>
<script src="openseadragon.min.js"></script><script>
const viewer = OpenSeadragon({ id: 'view', tileSources: 'albedo/info.json', showNavigationControl: false });
const seen = new Set(), failed = [];
viewer.addHandler('tile-loaded', (event) => seen.add(event.tile.getUrl()));
viewer.addHandler('tile-load-failed', (event) => failed.push(event.tile.getUrl()));
viewer.addHandler('open', () => viewer.viewport.zoomTo(viewer.viewport.imageToViewportZoom(1)));
</script>"""


def write(folder: Path, address: str, scale: int = 1) -> None:
    maps = surfaces.maps(roughness=0.5, specular=0.04)
    mesh = surfaces.mesh(maps)
    built = asset.with_extras(surfaces.built(maps, mesh), maps, mesh.depth, occlusion=False)
    if scale != 1:
        built = asset.resize_textures(built, scale * surfaces.WIDTH)
    iiif.write(folder, relightable_layer.pictures(built), {"name": "ball"}, address)
    openlime_page.write(folder / "index.html", {"title": "A <ball>", "rights": "© Museum"})


def test_a_deep_zoom_viewer_finds_every_tile(tmp_path: Path) -> None:
    if not VIEWER.exists():
        pytest.skip("needs `npm ci` in tests/gltf")
    shutil.copy(VIEWER, tmp_path)
    (tmp_path / "tiles.html").write_text(TILES)
    with served(tmp_path) as address:
        write(tmp_path, address, scale=8)
        with visited(f"{address}/tiles.html") as page:
            page.wait("document.readyState === 'complete'")
            page.wait("viewer.isOpen() && viewer.world.getItemAt(0).getFullyLoaded()")
            assert page.evaluate("failed.length") == 0
            asked = set(page.evaluate("[...seen]"))
    assert f"{address}/albedo/0,0,512,512/512,512/0/default.jpg" in asked  # a tile at full size
    assert any("/full/" in one or "/0,0,1280," in one for one in asked)  # and the coarsest


class Visit(NamedTuple):
    page: devtools.Page
    first: np.ndarray  # the page under a frontal light, (H, W, 3) 0…255


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visit]:
    folder = tmp_path_factory.mktemp("site")
    shutil.copy(Path(__file__).parent / "openlime_stand_in.js", folder / openlime_page.SCRIPT)
    with served(folder) as address:
        write(folder, address)
        with visited(f"{address}/index.html") as page:
            page.wait("document.documentElement?.dataset.ready > 0")
            yield Visit(page, page.screenshot())


def test_the_light_follows_the_pointer(visit: Visit) -> None:
    page, pictures = visit.page, [visit.first[:560]]  # above the words
    for x, y in ((240, 300), (660, 300), (450, 90)):
        before = page.evaluate("Number(document.documentElement.dataset.ready)")
        page.move(x, y)
        page.wait(f"document.documentElement.dataset.ready > {before}")
        pictures.append(page.screenshot()[:560])
    assert page.evaluate("document.title") == "A <ball>"
    assert page.complaints == []
    column, row = (share(picture) for picture in (pictures[2] - pictures[1], pictures[3] - pictures[0]))
    assert column[0] < 0 < column[1] and row[2] > 0 > row[3]  # right is brighter, and then above


def test_under_a_frontal_light_the_page_is_as_bright_as_the_photograph(visit: Visit) -> None:
    """OpenLIME divides the albedo by π under a light of irradiance 1; S0 of the photograph is under one of π."""
    shown = cv2.resize(visit.first, (surfaces.WIDTH, surfaces.HEIGHT))
    maps, front = surfaces.maps(roughness=0.5, specular=0.04), np.array([0.0, 0.0, 1.0])
    one = np.ones(maps.mask.shape)
    photograph = shade.stokes(
        maps.normal, maps.diffuse, maps.specular, maps.roughness, 1.5 * one, front + 0 * maps.normal, one
    )[0]
    facing = maps.mask & (maps.normal[..., 2] > 0.7)
    ratio = color.decode_srgb(shown / 255)[facing].mean() / photograph[facing].mean()
    assert 0.95 < ratio < 1.1


def share(difference: np.ndarray) -> tuple[float, ...]:
    """Mean of the left, right, upper and lower half."""
    height, width = difference.shape[:2]
    parts = (np.s_[:, : width // 2], np.s_[:, width // 2 :], np.s_[: height // 2], np.s_[height // 2 :])
    return tuple(float(difference[part].mean()) for part in parts)


def test_without_openlime_the_page_names_the_missing_file(tmp_path: Path) -> None:
    with served(tmp_path) as address:
        write(tmp_path, address)
        with visited(f"{address}/index.html") as page:
            page.wait("document.readyState === 'complete' && document.getElementById('words') !== null")
            assert "openlime.min.js" in page.evaluate("document.getElementById('words').textContent")
