"""The material model and the signs against Mitsuba 3's polarized plastic, which knows nothing of ours."""

import numpy as np
import plastic
import pytest

from polcap.optics import fresnel, shade

SIDE, SAMPLES, ALPHA, ALBEDO, RADIUS, FINE = 56, 512, 0.04, 0.5, 0.95, 8


@pytest.fixture(scope="module")
def stokes() -> np.ndarray:
    """(3, H, W): a sphere under a parallel light along the view, orthographic; rows run down."""
    mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (extra [test])")
    mi.set_variant("scalar_spectral_polarized")
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "stokes", "nested": {"type": "direct"}},
            "sensor": {
                "type": "orthographic",
                "to_world": view,
                "film": plastic.film(SIDE),
                "sampler": {"type": "independent", "sample_count": SAMPLES},
            },
            "light": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "d65", "scale": 1.0}},
            "ball": {
                "type": "sphere",
                "radius": RADIUS,
                "bsdf": plastic.plastic(
                    ALPHA, 1.5, {"type": "uniform", "value": ALBEDO}, {"type": "uniform", "value": 1.0}
                ),
            },
        }
    )
    image = np.array(mi.render(scene))
    aov = image[..., -12:].reshape(SIDE, SIDE, 4, 3).mean(axis=-1)  # S0.R S0.G S0.B … S3.B stand last
    assert np.abs(aov[..., 3]).max() < 1e-3 * aov[..., 0].max()  # no circular part
    return np.moveaxis(aov, -1, 0)[:3]


def sphere() -> np.ndarray:
    """Normals (H, W, F, F, 3) over each pixel's square, x right, y up; z = NaN beside the sphere."""
    at = ((np.arange(SIDE * FINE) + 0.5) / (SIDE * FINE) * 2 - 1) / RADIUS
    x, y = np.meshgrid(at, -at)
    with np.errstate(invalid="ignore"):
        n = np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)
    return n.reshape(SIDE, FINE, SIDE, FINE, 3).swapaxes(1, 2)


def pixels(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels wholly between two zenith angles, and the normals in them."""
    n = sphere()
    zenith = np.degrees(np.arccos(n[..., 2]))
    with np.errstate(invalid="ignore"):
        which = ((zenith > low) & (zenith < high)).all(axis=(2, 3))
    return which, n[which]  # (N, F, F, 3)


def test_dolp_follows_the_closed_form_within_three_percent(stokes: np.ndarray) -> None:
    which, n = pixels(20, 65)
    plus, minus = fresnel.transmission(n[..., 2], 1.5)
    light = n[..., 2] * plus  # cos θ T₊ enters
    double = n[..., 0] + 1j * n[..., 1]
    double = (double / np.abs(double)) ** 2
    expected = np.abs((light * minus * double).mean(axis=(1, 2))) / (light * plus).mean(axis=(1, 2))
    s0, s1, s2 = stokes[:, which]
    error = np.hypot(s1, s2) / s0 / expected - 1
    print(f"DoLP: mean {error.mean():+.4f}, worst {np.abs(error).max():.4f} over {error.size} pixels")
    assert np.abs(error).max() < 0.03


def test_aolp_is_the_normals_azimuth_within_half_a_degree(stokes: np.ndarray) -> None:
    which, n = pixels(20, 65)
    azimuth = np.arctan2(n[..., 1].mean(axis=(1, 2)), n[..., 0].mean(axis=(1, 2)))
    _, s1, s2 = stokes[:, which]
    off = np.degrees(np.angle((s1 + 1j * s2) * np.exp(-2j * azimuth)) / 2)
    print(f"AoLP: worst {np.abs(off).max():.3f}°")
    assert np.abs(off).max() < 0.5


def test_our_renderer_gives_the_same_stokes_parameters(stokes: np.ndarray) -> None:
    which, n = pixels(3, 65)
    ones = np.ones(n.shape[:-1])
    color = np.ones(n.shape)
    to_light = np.broadcast_to([0.0, 0.0, 1.0], n.shape)
    f0 = fresnel.normal_reflectance(1.5)
    ours = shade.stokes(n, ALBEDO * color, f0 * color, ALPHA**0.5 * ones, 1.5 * ones, to_light, ones)
    ours = ours[..., 0].mean(axis=(2, 3))  # (3, N)
    theirs = stokes[:, which]
    scale = (ours[0] @ theirs[0]) / (theirs[0] @ theirs[0])  # their light's unit
    ratio = scale * theirs[0] / ours[0]
    print(f"S0: spread {ratio.std():.4f}, worst {np.abs(ratio - 1).max():.4f}")
    assert np.abs(ratio - 1).max() < 0.03
    np.testing.assert_allclose(scale * theirs[1:], ours[1:], atol=0.03 * np.abs(ours[1:]).max())
    strong = np.abs(ours[1:]) > 0.1 * np.abs(ours[1:]).max()
    assert (np.sign(theirs[1:]) == np.sign(ours[1:]))[strong].all()
