"""A comparison lists the figures and settings that differ, and finds the changes of an object and nothing else."""

import json
import shutil
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from polcap import report
from polcap.image_values import Floats
from polcap.optics import frames
from polcap.report import changes, compare
from polcap.stage_values import SurfaceMaps
from tests import surfaces
from tests.conftest import Command


@pytest.fixture(scope="module")
def before() -> SurfaceMaps:
    """A ball with a pattern of colors and some noise."""
    return noisy(patterned(), 1)


def patterned() -> SurfaceMaps:
    ball = surfaces.maps(ripple=0.05, roughness=0.4, specular=0.04)
    height, width = ball.mask.shape
    random = np.random.default_rng(0)
    pattern = cv2.GaussianBlur(random.normal(size=(height, width, 3)).astype(np.float32), (0, 0), 3)
    diffuse = np.clip(0.4 + 1.5 * pattern, 0.05, 0.9) * ball.mask[..., None]
    return replace(ball, diffuse=diffuse.astype(np.float32), confidence=np.full((height, width), 4.0, np.float32))


def noisy(maps: SurfaceMaps, seed: int) -> SurfaceMaps:
    random = np.random.default_rng(seed)

    def noise(sigma: float, shape: tuple[int, ...]) -> Floats:
        return random.normal(scale=sigma, size=shape).astype(np.float32)

    return replace(
        maps,
        normal=frames.unit(maps.normal + noise(0.01, maps.normal.shape)),
        diffuse=np.maximum(maps.diffuse + noise(0.004, maps.diffuse.shape), 0.001),
        roughness=maps.roughness + noise(0.005, maps.roughness.shape),
    )


def spot(maps: SurfaceMaps, radius: int = 6) -> np.ndarray:
    """A disk in the middle of the object."""
    y, x = np.argwhere(maps.mask).mean(axis=0)
    rows, columns = np.indices(maps.mask.shape)
    return np.asarray(np.hypot(rows - y, columns - x) < radius)


def found(one: SurfaceMaps, other: SurfaceMaps) -> dict[str, float]:
    """Changed share of each quantity that changed."""
    measured = changes.measure(one, other)
    return {name: difference.share for name, difference in measured.differences.items() if difference.changed.any()}


def test_other_noise_is_no_change(before: SurfaceMaps) -> None:
    assert found(before, noisy(patterned(), 2)) == {}


def test_a_crop_at_another_place_and_of_another_size_is_no_change(before: SurfaceMaps) -> None:
    """The same photographs with another mask: a cut at the left, and a margin at the right."""
    again = noisy(patterned(), 2)
    height, width = again.mask.shape
    cut: dict[str, Any] = {
        name: np.pad(getattr(again, name)[:, 9:], ((0, 0), (0, 5), *[(0, 0)] * (getattr(again, name).ndim - 2)))
        for name in ("normal", "diffuse", "specular", "roughness", "confidence", "mask")
    }
    view = replace(
        again.view, center=(again.view.center[0] - 9, again.view.center[1]), origin=(again.view.origin[0] + 9, 0.0)
    )
    shifted = replace(again, **cut, view=view)
    assert shifted.mask.shape == (height, width - 4)
    measured = changes.measure(before, shifted)
    assert not any(difference.changed.any() for difference in measured.differences.values())
    assert measured.correlation > 0.98 and measured.differences["normal"].median < 1


def test_a_camera_that_turned_and_has_another_focal_length_is_no_change(before: SurfaceMaps) -> None:
    """The picture is 1.2 times as large, rolled by 5°, with the normals rolled too."""
    again = noisy(patterned(), 2)
    x, y = again.view.center
    size = (round(1.2 * again.mask.shape[1]), round(1.2 * again.mask.shape[0]))
    matrix = cv2.getRotationMatrix2D((x, y), 5.0, 1.2)
    matrix[:, 2] += [0.2 * x, 0.2 * y]
    turned = {
        name: cv2.warpAffine(getattr(again, name).astype(np.float32), matrix, size)
        for name in ("normal", "diffuse", "specular", "roughness", "confidence", "mask")
    }
    cosine, sine = np.cos(np.radians(5)), np.sin(np.radians(5))
    roll = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)
    turned["normal"] = frames.unit(turned["normal"] @ roll.T)
    view = replace(again.view, focal=1.2 * again.view.focal, center=(1.2 * x, 1.2 * y))
    other = replace(again, **{**turned, "mask": turned["mask"] > 0.5}, view=view)
    measured = changes.measure(before, other)
    assert measured.turn_deg == pytest.approx(5, abs=0.5)
    assert not any(difference.changed.any() for difference in measured.differences.values())


def test_a_stain_is_a_change_of_color_alone_and_at_its_place(before: SurfaceMaps) -> None:
    again = patterned()
    at = spot(again)
    stained = replace(again, diffuse=np.where(at[..., None], again.diffuse * [0.7, 0.5, 0.4], again.diffuse))
    measured = changes.measure(before, noisy(replace(stained, diffuse=stained.diffuse.astype(np.float32)), 2))
    changed = measured.differences["color"].changed
    assert (changed & at).sum() > 0.6 * at.sum() and (changed & ~spot(again, 10)).sum() == 0
    assert not measured.differences["normal"].changed.any() and not measured.differences["roughness"].changed.any()


def test_a_dent_is_a_change_of_the_normals(before: SurfaceMaps) -> None:
    again = patterned()
    bent = np.where(spot(again)[..., None], again.normal + np.array([0.5, 0, 0], np.float32), again.normal)
    assert set(found(before, noisy(replace(again, normal=frames.unit(bent)), 2))) == {"normal"}


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_a_new_varnish_on_a_part_or_on_all_is_a_change_of_roughness(before: SurfaceMaps, share: float) -> None:
    again = patterned()
    columns = np.flatnonzero(again.mask.any(axis=0))
    part = np.arange(again.mask.shape[1]) <= np.quantile(columns, share)
    varnished = replace(again, roughness=np.where(part, again.roughness - 0.2, again.roughness).astype(np.float32))
    assert found(before, noisy(varnished, 2)) == {"roughness": pytest.approx(share, abs=0.12)}


def glossed(maps: SurfaceMaps, part: np.ndarray, inside: float, outside: float) -> SurfaceMaps:
    """The maps with two roughnesses, each with an expected error of 0.06."""
    roughness = np.where(part, inside, outside).astype(np.float32)
    return replace(maps, roughness=roughness, roughness_error=np.full_like(roughness, 0.06))


def test_a_material_that_only_one_result_divides_is_no_change_of_roughness() -> None:
    maps = patterned()
    part = spot(maps, 20)
    whole, divided = glossed(noisy(maps, 1), part, 0.4, 0.4), glossed(noisy(maps, 2), part, 0.54, 0.38)
    assert found(whole, divided) == {} and found(divided, whole) == {}
    assert found(whole, glossed(noisy(maps, 2), part, 0.25, 0.25)) == {"roughness": pytest.approx(1, abs=0.05)}
    polished = glossed(noisy(maps, 2), part, 0.74, 0.38)
    assert found(divided, polished) == {"roughness": pytest.approx(part.sum() / maps.mask.sum(), rel=0.3)}


def test_albedos_of_unknown_scale_are_compared_by_their_pattern(before: SurfaceMaps) -> None:
    darker = noisy(replace(patterned(), diffuse=patterned().diffuse * np.float32(0.6)), 2)
    assert found(before, darker) == {}
    known = replace(darker, albedo_sigma=0.05)
    assert set(found(replace(before, albedo_sigma=0.05), known)) == {"color"}


def test_another_object_is_not_compared(before: SurfaceMaps) -> None:
    random = np.random.default_rng(9)
    pattern = cv2.GaussianBlur(random.normal(size=before.diffuse.shape).astype(np.float32), (0, 0), 4)
    other = replace(before, diffuse=np.clip(0.4 + 3 * pattern, 0.02, 0.9), normal=before.normal * [-1, -1, 1])
    assert not changes.measure(before, other).usable


def test_comparison_names_figures_and_settings_that_differ(result: Path) -> None:
    one = report.read(result)
    other = json.loads(json.dumps(one))
    other["figures"]["maps"]["estimator"] = "network"
    other["settings"]["hdr"]["clip"] = 0.9
    rows = {name: (here, there) for name, here, there in compare.rows(one, other)}
    assert rows["figures.maps.estimator"] == ("analytic", "network")
    assert set(rows) == {"figures.maps.estimator", "settings.hdr.clip"}
    assert compare.rows(one, one) == []


def test_comparison_is_a_page_like_the_report(result: Path, tmp_path: Path) -> None:
    about = report.read(result)
    changed = json.loads(json.dumps(about))
    changed["figures"]["maps"]["roughness_median"] = 0.5
    sentence, rows = compare.write(tmp_path / "compare.html", (result, result), (about, changed))
    page = unescape((tmp_path / "compare.html").read_text())
    assert sentence.startswith("Nothing changed") and sentence in page and len(rows) == 3
    assert "<td>Maps: Median roughness</td>" in page and "<td>0.5</td>" in page
    assert page.count('class="map"') == 12 and 'type="range"' in page


def test_archives_are_compared_and_stay_as_they_are(result: Path, tmp_path: Path, polcap: Command) -> None:
    archives = [tmp_path / "first", tmp_path / "second"]
    for archive in archives:  # a copy without the record of polcap's files
        shutil.copytree(result / "maps", archive / "maps")
        shutil.copy(result / "report.json", archive)
    before = sorted(tmp_path.rglob("*"))
    assert polcap("report", archives[0], "--compare", archives[1]).returncode == 2
    assert sorted(tmp_path.rglob("*")) == before
    for _ in range(2):
        done = polcap("report", archives[0], "--compare", archives[1], "--out", tmp_path / "page")
        assert done.returncode == 0 and done.stdout.startswith("Nothing changed beyond the doubt"), done.stderr
    assert {file.name for file in (tmp_path / "page").iterdir()} == {"compare.html", "polcap-files.txt"}
    assert set(tmp_path.rglob("*")) - set(before) == {tmp_path / "page", *(tmp_path / "page").iterdir()}
    assert "add --compare OTHER" in polcap("report", archives[0], "--out", tmp_path / "page").stderr
