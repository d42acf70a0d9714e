"""Normals and materials of a ball with known normals, by inversion and by fake networks."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from polcap.capture_values import ShotOrder
from polcap.errors import ModelError
from polcap.image_values import Quality
from polcap.optics import frames
from polcap.pipeline import models
from polcap.stage_values import OutlineCheck
from polcap.stages import cues, infer
from polcap.stages.infer import analytic, fine, learned
from polcap.stages.infer.sizes_and_positions import _turn, _turn_vectors, _without_grid, predict
from polcap.stages.selfcal.angles import other_orders
from tests import scenes
from tests.fake_network import FakeNetwork, run
from tests.scenes import seen


def estimate(found, model=None):
    return infer.estimate(found, model, run, infer.InferSettings())


def middle(found):
    """The rows and columns of the object that are 60 px or more from its edges."""
    rows, columns = np.nonzero(found.mask)
    return np.s_[rows.min() + 60 : rows.max() - 60, columns.min() + 60 : columns.max() - 60]


def spot(found):
    """A small part of the object, below its middle."""
    rows, columns = np.nonzero(found.mask)
    y, x = round(rows.mean()) + 25, round(columns.mean())
    return np.s_[y - 6 : y + 7, x - 9 : x + 10]


def errors_deg(maps, cues_) -> np.ndarray:
    local, mask = scenes.truth()
    return frames.angle_deg(maps.normal, frames.from_ray_frame(local, cues_.rays))[mask & maps.mask]


@pytest.mark.parametrize(("albedo", "doubled"), [(0.95, False), (1.4, True)])
def test_white_things_are_no_evidence_of_a_chart_with_less_light(
    albedo: float, doubled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chart got half of the light only where more comes back than from the whitest surface; highlights are none."""
    found = seen(noise=0.002, textured=False)
    local, _ = scenes.truth()
    highlight = 3.0 * (local[..., 2:] > 0.95)
    lit = replace(found, scale_sigma=0.1, radiance=albedo / 0.5 * found.radiance + highlight)
    maps = analytic.estimate(lit, 1.5)
    for estimator in (analytic, learned):
        monkeypatch.setattr(estimator, "estimate", lambda *_, **__: maps)
    expected = np.sqrt(0.1**2 + 0.05**2 + np.log(2) ** 2 * (1.0 if doubled else 0.01))
    for model in (None, object()):
        assert estimate(lit, model).albedo_sigma == pytest.approx(expected, abs=0.06)
    assert estimate(replace(lit, scale_sigma=None)).albedo_sigma is None


def test_a_clean_ball_is_recovered():
    found = seen(noise=1e-5)
    error = errors_deg(estimate(found), found)
    assert np.median(error) < 1.0
    assert error.mean() < 2.0  # the outline's last pixel is half backdrop


def test_a_noisy_textured_ball_is_recovered_and_its_error_predicted():
    found = seen(noise=0.004)
    maps = estimate(found)
    error = errors_deg(maps, found)
    assert error.mean() < 5.0
    local, mask = scenes.truth()
    expected = maps.confidence[mask & maps.mask]
    assert error.mean() < expected.mean() < error.mean() + 5  # 4° are for interreflection, which is absent here
    tilted = local[mask & maps.mask, 2] < 0.9
    assert (error[tilted] < 90).mean() > 0.995 and expected[tilted].mean() < 10  # normals lean outward


def test_albedo_is_free_of_shading():
    found = seen(noise=1e-4, textured=False)
    maps = estimate(found)
    local, mask = scenes.truth()
    ring = mask & (local[..., 2] > 0.5) & (local[..., 2] < 0.85)
    assert np.abs(maps.diffuse[ring] - 0.5).mean() < 0.03


@pytest.mark.parametrize("known", [True, False])
def test_albedo_goes_on_into_saturated_highlights(known: bool):
    found = seen(noise=1e-4, textured=False)
    bright = spot(found) if known else np.s_[:, :]
    radiance, quality = found.radiance.copy(), found.quality.copy()
    radiance[bright], quality[bright] = 4.0, quality[bright] | Quality.CLIPPED
    burnt = replace(found, radiance=radiance, quality=quality)
    for estimator in (None, network()):
        albedo = estimate(burnt, estimator).diffuse
        assert np.isfinite(albedo).all()
        if known:  # this network returns 0.3, the inversion about 0.5
            whole = estimate(found, estimator).diffuse
            assert np.abs(albedo - whole)[bright].mean() < 0.03, estimator


def test_what_is_brighter_than_any_body_is_not_painted_on_it():
    """A highlight that no exposure lost, and a network that takes all light for the body's."""
    found = seen(noise=1e-4, textured=False)
    radiance = found.radiance.copy()
    radiance[spot(found)] = 30.0
    believing = replace(
        network(), answer=lambda picture: network().answer(picture) | {"diffuse": np.exp(picture[:, :3]).clip(0, 1)}
    )
    shining = replace(found, radiance=radiance)
    albedo, whole = (estimate(c, believing).diffuse for c in (shining, found))
    assert np.abs(albedo - whole)[spot(found)].mean() < 0.05


def network(channels=cues.CHANNELS) -> FakeNetwork:
    """A network that answers with the zenith channels' own normal: its maps are known in closed form."""

    def answer(picture):
        x, y = picture[:, 5:6], picture[:, 6:7]
        tilt = np.sqrt(x * x + y * y)
        phi = np.arctan2(y, x) / 2
        normal = np.concatenate([np.sin(tilt) * np.cos(phi), np.sin(tilt) * np.sin(phi), np.cos(tilt)], axis=1)
        one = np.ones_like(x)
        return {"normal": normal, "depth": 0 * one, "diffuse": np.repeat(0.3 * one, 3, 1),
                "specular": np.repeat(0.04 * one, 3, 1), "roughness": 0.4 * one, "sigma": 5 * one}  # fmt: skip

    return FakeNetwork("0123456789", channels, {"native_size": "256", "size_multiple": "32"}, answer=answer)


def test_a_model_of_other_channels_or_maps_is_refused():
    with pytest.raises(ModelError, match="expects channels red"):
        estimate(seen(), network(("red",)))
    with pytest.raises(ModelError, match="this version needs"):
        estimate(seen(), replace(network(), answer=lambda _: {"normal": np.zeros((1, 3, 32, 32))}))


def test_a_crop_larger_than_the_network_sees_keeps_its_texture():
    """The network returns grey 0.3 everywhere; finer detail comes from S0, up to the object's edge."""
    found = seen(noise=1e-4)
    half = replace(network(), metadata={"native_size": "128", "size_multiple": "32"})
    maps = estimate(found, half)
    core = middle(found)
    texture = found.radiance[core] / cv2.GaussianBlur(found.radiance, (0, 0), 4)[core]
    albedo = maps.diffuse[core]
    assert albedo.mean() == pytest.approx(0.3, rel=0.05)
    assert np.corrcoef(albedo.ravel(), texture.ravel())[0, 1] > 0.8
    edge = found.mask & (cv2.erode(found.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    assert np.median(maps.diffuse[edge]) == pytest.approx(0.3, rel=0.35)  # S0 falls to nothing there


def gridded(pattern, *names) -> FakeNetwork:
    """`network` with a pattern (2, 2) of factors repeated over some of its maps."""

    def answer(picture):
        maps = network().answer(picture)
        tiles = np.tile(pattern, (picture.shape[2] // 2, picture.shape[3] // 2)).astype(np.float32)
        return maps | {name: maps[name] * tiles for name in names}

    return replace(network(), answer=answer)


GRID = np.array([[0.9, 1.1], [1.1, 0.9]])
SINGLE = np.array([[1.05, 0.95], [0.95, 0.95]])


@pytest.mark.parametrize("pattern", [GRID, SINGLE], ids=["checkered", "single pixels"])
def test_a_grid_of_the_network_does_not_reach_its_maps(pattern):
    found = seen(noise=1e-4, textured=False)
    names = ("diffuse", "roughness", "specular")
    maps = estimate(found, gridded(pattern, *names))
    for name in names:
        part = getattr(maps, name)[middle(found)]
        means = [part[y::2, x::2].mean() for y in (0, 1) for x in (0, 1)]
        assert np.ptp(means) / np.mean(means) < 2e-3, name


def test_relief_that_the_network_does_not_see_leaves_the_albedo(monkeypatch):
    """Waves of one color, 5 px long and 45° steep, of which the network sees no more than grey 0.3."""
    found = seen(noise=1e-4)
    steep = np.tan(np.radians(45)) * np.sin(2 * np.pi * np.arange(found.mask.shape[1]) / 5)
    local = np.stack([steep, 0 * steep, 1 + 0 * steep], -1) / np.sqrt(1 + steep**2)[:, None]
    waves = frames.from_ray_frame(np.broadcast_to(local, (*found.mask.shape, 3)), found.rays)
    lit = np.repeat(0.3 * local[None, :, 2:] * found.mask[..., None], 3, axis=-1).astype(np.float32)
    found = replace(found, radiance=lit)
    half = replace(network(), fine=network(), metadata={"native_size": "64", "size_multiple": "32"})
    core = middle(found)
    spread = []
    for normal in (found.rays, waves):
        monkeypatch.setattr(fine, "refine", lambda cues_, guess, network_, run_, known=normal: known)
        albedo = estimate(found, half).diffuse[core]
        spread.append(np.log(albedo + cues.FLOOR).std())
    assert spread[1] == pytest.approx(spread[0] / 2, rel=0.1)


def test_a_grid_of_the_network_does_not_reach_the_normals_and_relief_does():
    """A 2 px pattern of ±3° that fades across the object goes; relief of 7 and of 3 px a wave stays."""
    y, x = np.mgrid[:160, :160]
    mask = np.hypot(x - 80, y - 80) < 70
    relief = 0.15 * np.sin(2 * np.pi * x / 7) + 0.05 * np.sin(2 * np.pi * y / 3)
    grid = 0.05 * np.where((x % 2 == 0) & (y % 2 == 1), 1.0, -0.3) * (x / 160)
    clean, seen_ = (np.stack([relief + part, 0 * x, 1 + 0 * x], axis=-1) * mask[..., None] for part in (0 * x, grid))
    found = _without_grid(seen_, mask)
    core = cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    before, after = (np.sqrt(np.mean((n - clean)[core] ** 2)) for n in (seen_, found))
    pattern = (np.bincount(((x % 2) + 2 * (y % 2))[core], (n - clean)[..., 0][core]) for n in (seen_, found))
    uneven, even = (np.ptp(sums) for sums in pattern)
    assert even < 0.1 * uneven and after < before
    assert np.array_equal(_without_grid(seen_ + 1, mask)[~mask], (seen_ + 1)[~mask].astype(np.float32))
    bare = _without_grid(clean, mask)
    assert np.sqrt(np.mean((bare - clean)[core] ** 2)) < 0.02 * np.std(relief)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_guide_settles_the_half_turn(side: float):
    """Guided by the truth or by its opposite, the inversion returns that side of every clear axis."""
    found = seen(noise=1e-5)
    local, mask = scenes.truth()
    guide = local * [side, side, 1]
    normal, _, _ = analytic.invert(found, infer.InferSettings().ior, (guide, np.full(mask.shape, 5.0)))
    error = frames.angle_deg(frames.to_ray_frame(normal, found.rays), guide)
    assert np.median(error[mask & found.mask]) < 1.0


def test_detail_is_kept_and_a_bend_is_not():
    """Relief of a few pixels comes from the fine normals, tilts of whole regions from the coarse ones."""
    y, x = np.mgrid[:128, :128]
    tilt = np.tile([0.0, 0.0, 1.0], (128, 128, 1))
    coarse, fine, truth = (tilt + np.array(tilted) for tilted in ([0.2, 0, 0], [-0.3, 0.1, 0], [0.2, 0, 0]))
    relief = 0.2 * np.sin(x / 2)
    fine[..., 1] += relief
    truth[..., 1] += relief
    coarse, fine, truth = (frames.unit(n) for n in (coarse, fine, truth))
    mask = np.hypot(x - 64, y - 64) < 55
    error = frames.angle_deg(learned._add_detail(coarse, fine, mask, 4.0), truth)[mask]
    assert np.median(error) < 1.0 and np.quantile(error, 0.99) < 6.0


def test_a_guide_is_as_sure_as_its_error_is_small():
    """P(right) − P(wrong) of a Gaussian: 68.3 % at one standard deviation from the axis."""
    axis, rays = np.array([[[1.0, 1.0]], [[0.0, 0.0]]]), np.full((1, 2, 3), [0.0, 0.0, 1.0])
    tilt = np.radians(10.0)
    normal = np.full((1, 2, 3), [-tilt, 0.0, 1.0])
    phi, certainty = analytic._azimuth_by_guide(axis, rays, normal, np.array([[10.0, 2.0]]))
    np.testing.assert_allclose(np.cos(phi), -1)
    np.testing.assert_allclose(certainty, [[0.6827, 1.0]], atol=1e-3)


def test_a_half_turn_that_nothing_settles_costs_the_zenith():
    """A guide across the axis leaves both sides as likely: 2θ of error in half of the cases."""
    found = seen(noise=1e-5, textured=False)
    local, mask = scenes.truth()
    across = np.stack([-local[..., 1], local[..., 0], local[..., 2]], axis=-1)
    settled, open_ = (
        analytic.invert(found, infer.InferSettings().ior, (guide, np.full(mask.shape, 5.0)))[1]
        for guide in (local, across)
    )
    tilted = mask & found.mask & (local[..., 2] > 0.5) & (local[..., 2] < 0.9)
    zenith = np.degrees(np.arccos(local[tilted, 2]))
    assert np.median((open_ - settled)[tilted] / zenith) == pytest.approx(1.0, abs=0.1)


def lopsided() -> FakeNetwork:
    """A network without symmetry: its maps depend on the position in the picture and on single channels."""

    def answer(picture):
        y, x = np.mgrid[: picture.shape[2], : picture.shape[3]] / 100.0
        a = picture[:, 3:4] + 0.3 * picture[:, 5:6] + 0.1 * x
        b = picture[:, 4:5] - 0.2 * picture[:, 12:13] + 0.1 * y
        c = 1.5 + 0.1 * picture[:, 6:7] + 0.2 * picture[:, 13:14]
        normal = np.concatenate([a, b, c], axis=1) / np.sqrt(a * a + b * b + c * c)
        return {"normal": normal, "depth": a * b, "diffuse": 0.3 + 0 * normal,
                "specular": 0.04 + 0.01 * normal, "roughness": 0.5 + 0.1 * b, "sigma": 5 + a}  # fmt: skip

    return replace(network(), answer=answer)


@pytest.mark.parametrize(("quarters", "mirror"), [(1, False), (2, False), (0, True), (3, True)])
def test_averaged_over_turns_a_turned_object_gets_the_turned_maps(quarters: int, mirror: bool):
    """The symmetry holds exactly whatever the network, also for oblique rays."""
    found = seen(noise=1e-4)
    images: dict[str, Any] = {
        name: np.array(_turn(getattr(found, name), quarters, mirror))
        for name in ("radiance", "ratio_sigma", "dolp", "mask", "quality", "rays")
    }
    for name in ("ratio", "normalized_stokes"):
        s1, s2 = (_turn(part, quarters, mirror) for part in getattr(found, name))
        images[name] = (-1.0) ** quarters * np.stack([s1, -s2 if mirror else s2])
    images["rays"][..., :2] = _turn_vectors(images["rays"][..., :2], quarters, mirror)
    moved = replace(found, **images)
    whole, turned = (predict([c], lopsided(), run, 8) for c in (found, moved))
    np.testing.assert_allclose(turned["depth"], _turn(whole["depth"], quarters, mirror), atol=1e-4)
    expected = np.array(_turn(whole["normal"], quarters, mirror))
    expected[..., :2] = _turn_vectors(expected[..., :2], quarters, mirror)
    np.testing.assert_allclose(turned["normal"], expected, atol=1e-4)


@pytest.mark.parametrize("swapped", [False, True])
def test_the_shipped_network_expects_larger_errors_in_a_wrong_order(swapped: bool) -> None:
    stated = ShotOrder((0, 1, 2))
    found = seen(noise=0.002)
    others = other_orders(OutlineCheck(stated, 0.0), scenes.ANGLES)
    exchanged = next(other for other in others if other.order == ShotOrder((2, 1, 0)))
    if swapped:
        found = learned._transformed(found, exchanged.matrix)
    found = replace(found, other_orders=others)
    order = estimate(found, models.load_network("network", None, "cpu", 1)).order
    assert order is not None
    if swapped:
        assert order.ratio < 0.8 and order.rival == exchanged.order
        return
    assert order.ratio > 1.2
    assert estimate(found).order is None  # the inversion expects nothing
    thread = np.zeros_like(found.mask)
    thread[:, found.mask.shape[1] // 2] = found.mask[:, found.mask.shape[1] // 2]
    thin = replace(found, mask=thread)
    assert learned._compare_orders(thin, network(), run) is None  # nothing is left of it in the small picture
