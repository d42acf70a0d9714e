"""report.html in a browser without network: it opens, the light moves, the pointer reads the maps."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from polcap.formats.maps import maps_folder as maps
from polcap.optics import color, frames, shade
from tests.render import devtools


@pytest.fixture(scope="module")
def page(result: Path) -> Iterator[devtools.Page]:
    with devtools.opened() as page:
        page.open(result / "report.html", 1280, 900)
        yield page


def test_page_opens_without_network_or_complaint(page: devtools.Page, result: Path) -> None:
    for width, height in ((390, 844), (768, 1024), (1280, 900)):
        page.open(result / "report.html", width, height)
        assert page.evaluate("document.documentElement.dataset.ready") == "yes"
        assert page.evaluate("document.documentElement.scrollWidth") == width  # nothing sticks out
    assert page.complaints == []
    assert [address for address in page.asked if not address.startswith(("data:", "file:"))] == []


def test_page_prints_with_its_pictures(page: devtools.Page) -> None:
    printed = page.pdf()
    assert printed.startswith(b"%PDF") and printed.count(b"/Subtype /Image") + printed.count(b"/Subtype/Image") > 10


def test_light_follows_the_pointer(page: devtools.Page) -> None:
    for x, bright, dark in ((-0.9, 0, 1), (0.9, 1, 0)):
        page.evaluate(f"relight.aim({x}, 0); relight.draw()")
        halves = [half.mean() for half in np.array_split(page.canvas("relight"), 2, axis=1)]
        assert halves[bright] > 1.5 * halves[dark]


def test_a_moving_light_is_drawn_smaller_on_a_slow_machine_and_in_full_at_rest(page: devtools.Page) -> None:
    size = "[relight.canvas.width, relight.canvas.height]"
    whole = page.evaluate(f"(relight.draw(), {size})")
    small = page.evaluate(f"(relight.share = 1 / 4, relight.follow(), {size})")
    assert small == [-(-side // 4) for side in whole]
    assert page.evaluate(f"new Promise((done) => setTimeout(() => done({size}), 4 * REST))") == whole


@pytest.mark.parametrize("light", [(0.0, 0.0), (0.6, 0.3), (-0.5, -0.7)])
def test_light_obeys_the_law_of_the_maps(page: devtools.Page, result: Path, light: tuple[float, float]) -> None:
    page.evaluate(f"relight.aim({light[0]}, {light[1]}); relight.draw()")
    drawn = page.canvas("relight")
    exposure, ior = page.evaluate("[DATA.view.exposure, DATA.view.ior]")
    stored = maps.read(result / "maps")
    ray = frames.rays(stored.view, *stored.mask.shape)
    to_light = np.array([*light, np.sqrt(1 - light[0] ** 2 - light[1] ** 2)])
    local = frames.to_ray_frame(np.broadcast_to(to_light, ray.shape), ray)
    one = np.ones(stored.mask.shape)
    normal = frames.to_ray_frame(stored.normal, ray)
    law = shade.stokes(normal, stored.diffuse, stored.specular, stored.roughness, ior * one, local, one)[0]
    expected = 255 * color.encode_srgb(np.clip(exposure * law, 0, 1))
    inside = stored.mask & (normal[..., 2] > 0.3) & (expected.max(axis=-1) < 250)
    difference = np.abs(drawn - expected)[inside]
    assert np.median(difference) < 2 and np.percentile(difference, 95) < 12  # of 255: 8-bit normals, albedos as JPEG


def test_the_mesh_turns_and_shows_its_normals(page: devtools.Page) -> None:
    page.evaluate("solid.turn = [0, 0]; solid.draw()")
    front = page.canvas("solid")
    page.evaluate("solid.rotate(0.8, 0); solid.draw()")
    turned = page.canvas("solid")
    page.evaluate("document.querySelector('[data-mode=\"2\"]').click(); solid.draw()")
    normals = page.canvas("solid")
    assert (front.max(axis=-1) > 40).mean() > 0.05
    assert np.abs(front - turned).mean() > 2 and np.abs(turned - normals).mean() > 2


def test_pointer_reads_the_maps(page: devtools.Page, result: Path) -> None:
    stored = maps.read(result / "maps")
    height, width = stored.mask.shape
    row, column = np.argwhere(stored.mask & (stored.normal[..., 2] > 0.9))[500]
    page.evaluate(f"point({(column + 0.5) / width}, {(row + 0.5) / height})")
    texts = {
        name: page.evaluate(f"document.querySelector('#map-{name} output').textContent")
        for name in ("normal", "diffuse", "roughness", "error", "depth")
    }
    numbers = {name: np.array([float(n) for n in re.findall(r"-?[\d.]+", text)]) for name, text in texts.items()}
    assert np.allclose(numbers["normal"], stored.normal[row, column], atol=0.011)  # 8 bits, two digits
    assert np.allclose(numbers["diffuse"], stored.diffuse[row, column], atol=0.04)  # JPEG
    assert np.allclose(numbers["roughness"], stored.roughness[row, column], atol=0.01)
    assert np.allclose(numbers["error"], stored.confidence[row, column], atol=0.35)
    assert np.allclose(numbers["depth"], stored.depth[row, column], rtol=2e-3)
