"""Body light of rough surfaces: the smooth law is its limit, and facets drawn at random agree with the table."""

import numpy as np
import pytest
from array_api_compat import array_namespace

from polcap.image_values import Floats
from polcap.optics import body, fresnel, shade

# Ratio of the DoLP to the smooth interface's, n = 1.5, by an integral over visible facets that is not this code
ZENITH_DEG = (10, 20, 32, 44, 56, 68, 74)
RATIO = {
    0.1: (0.96, 0.96, 0.96, 0.94, 0.92, 0.87, 0.83),
    0.2: (0.88, 0.87, 0.86, 0.83, 0.77, 0.68, 0.60),
    0.3: (0.76, 0.75, 0.73, 0.68, 0.61, 0.50, 0.43),
    0.4: (0.63, 0.61, 0.58, 0.53, 0.46, 0.36, 0.30),
    0.5: (0.47, 0.45, 0.43, 0.39, 0.33, 0.24, 0.20),
    0.6: (0.31, 0.29, 0.28, 0.25, 0.21, 0.16, 0.13),
}
# Two real matte balls under a near-frontal light: DoLP over the smooth law's, n = 1.5
BALLS = {32: (0.82, 0.84), 44: (0.71, 0.73), 56: (0.59, 0.65), 68: (0.50, 0.55)}


@pytest.mark.parametrize("alpha", RATIO)
def test_facets_depolarize_as_published(alpha: float) -> None:
    c = np.cos(np.radians(ZENITH_DEG))
    ratio = body.dolp(c, alpha, 1.5) / body.dolp(c, 0.0, 1.5)
    np.testing.assert_allclose(ratio, RATIO[alpha], atol=0.015)


def test_real_balls_follow_one_roughness() -> None:
    c = np.cos(np.radians(list(BALLS)))
    measured = np.array(list(BALLS.values())).T
    for alphas, local in (((0.25, 0.3), 0.0), ((0.2, 0.25), 1.0)):
        for ball in measured:
            ratio = np.array([body.dolp(c, alpha, 1.5, local) / body.dolp(c, 0.0, 1.5) for alpha in alphas])
            difference = np.sqrt(np.mean((ratio / ball - 1) ** 2, axis=1)).min()
            assert difference < 0.11


@pytest.mark.parametrize("ior", [1.35, 1.5, 1.62])
def test_smooth_interface_is_the_limit(ior: float) -> None:
    c = np.linspace(0.01, 1, 200)
    plus, minus = body.leaving(c, 0.0, ior)
    np.testing.assert_allclose((plus, minus), fresnel.transmission(c, ior), rtol=1e-12, atol=1e-15)
    away = c[(c > 0.3) & (c < 0.99)]  # not near the outline
    assert np.abs(body.dolp(away, 0.02, ior) / body.dolp(away, 0.0, ior) - 1).max() < 0.04


@pytest.mark.parametrize("local", [0.0, 1.0])
@pytest.mark.parametrize(("alpha", "ior"), [(0.15, 1.5), (0.35, 1.42), (0.6, 1.58)])
def test_facets_drawn_at_random_agree(alpha: float, ior: float, local: float) -> None:
    """Slopes of GGX are a bivariate t distribution; each facet's light is turned by its own plane of incidence."""
    rng = np.random.default_rng(7)
    count = 400_000
    slope = alpha / np.sqrt(2) * rng.normal(size=(2, count)) / np.sqrt(rng.exponential(size=count))
    facet = np.stack([-slope[0], -slope[1], np.ones(count)], axis=1)
    area = np.linalg.norm(facet, axis=1)
    facet /= area[:, None]
    for degrees in (25, 50, 70):
        zenith = np.radians(degrees)
        ray = np.array([np.sin(zenith), 0, np.cos(zenith)])
        across = np.array([0.0, 1, 0])
        towards = np.cross(across, ray)  # (cos, 0, −sin): away from the normal
        seen = facet @ ray
        weight = np.where(seen > 0, seen * area, 0)  # projected area of the facets on one patch of the plane
        seen = np.clip(seen, 1e-6, 1)
        inside = np.sqrt(1 - (1 - seen**2) / ior**2)
        through_s = 1 - ((seen - ior * inside) / (seen + ior * inside)) ** 2
        through_p = 1 - ((ior * seen - inside) / (ior * seen + inside)) ** 2
        weight = weight * (seen * (through_s + through_p) / 2) ** local
        plane = np.stack([facet @ towards, facet @ across], axis=1)
        plane /= np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
        s0 = np.sum(weight * (through_s + through_p) / 2)
        s1 = np.sum(weight * (through_p - through_s) / 2 * (plane[:, 0] ** 2 - plane[:, 1] ** 2))
        found = body.dolp(np.array([np.cos(zenith)]), alpha, ior, local)[0]
        assert found == pytest.approx(s1 / s0, abs=0.02 * body.dolp(np.cos(zenith), 0.0, ior) + 2e-4)
        if local == 0:
            assert body.leaving(np.array([np.cos(zenith)]), alpha, ior)[0][0] == pytest.approx(
                s0 / weight.sum(), abs=0.004
            )


def test_rough_bodies_are_flatter_than_lambert() -> None:
    """Seen from the flash, facets that face it brighten the outline; light that is spread evenly inside does not."""
    zenith = np.radians([0, 20, 40, 60, 70])
    c = np.cos(zenith)
    for alpha in (0.2, 0.5):
        facet, _, weight = body.facets(c, alpha)
        plus, _ = fresnel.transmission(facet, 1.5)
        light = (weight * facet * plus**2).sum(axis=1) / (c * (weight * plus).sum(axis=1) ** 2)
        np.testing.assert_allclose(body.flattening(c, c, np.ones(5), alpha + 0 * c), light / light[0], rtol=0.08)


def test_renderer_draws_the_law() -> None:
    zenith = np.radians([15, 40, 65])
    normal = np.stack([np.sin(zenith), 0 * zenith, np.cos(zenith)], axis=-1)
    color, one = np.ones((3, 3)), np.ones(3)
    light = np.array([[0.0, 0, 1]] * 3)

    def drawn(law: body.Law) -> Floats:
        rough = 0.5 * one
        return np.asarray(shade.stokes(normal, 0.5 * color, 0 * color, rough, 1.5 * one, light, one, law)[..., 0])

    smooth = drawn(body.SMOOTH)
    np.testing.assert_allclose(drawn(body.Law(0 * one, 0 * one, one)), smooth, rtol=1e-12, atol=1e-15)
    rough = drawn(body.Law(one, 0 * one, 0.9 * one))
    expected = 0.9 * body.dolp(normal[:, 2], 0.25, 1.5)
    np.testing.assert_allclose(rough[1] / rough[0], expected, rtol=1e-6)
    local = drawn(body.Law(one, one, one))
    assert (local[0] / local[0, 0] > rough[0] / rough[0, 0])[1:].all()


def test_numpy_and_torch_agree() -> None:
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    arrays = [rng.uniform(0, 1, 500), rng.uniform(0, 1, 500), rng.uniform(1.3, 1.7, 500), rng.uniform(0, 1, 500)]
    tensors = [torch.from_numpy(a) for a in arrays]
    for ours, theirs in zip(body.leaving(*tensors), body.leaving(*arrays)):
        assert array_namespace(ours) is not np
        np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-12)
