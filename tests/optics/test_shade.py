"""The renderer of maps against closed forms, energy and the signs of the two kinds of polarization."""

import numpy as np
import pytest

from polcap.optics import crossing, frames, fresnel, shade

UP = np.array([0.0, 0.0, 1.0])


def tilted(zenith_deg: float, azimuth_deg: float = 0.0) -> np.ndarray:
    t, p = np.radians([zenith_deg, azimuth_deg])
    return np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])


def render(normal, light, axis_deg=None, *, diffuse=0.0, specular=0.0, roughness=0.4) -> np.ndarray:
    """(3,) Stokes parameters of the first channel under unit irradiance, polarized along an axis of the picture."""
    color, one, across = np.ones(3), np.array(1.0), None
    if axis_deg is not None:
        axis = tilted(90, axis_deg)
        across = frames.unit(axis - light * (axis @ light))
    out = shade.stokes(
        normal, diffuse * color, specular * color, roughness * one, 1.5 * one, light, one, axis=across
    )  # fmt: skip
    return np.asarray(out[:, 0])


@pytest.mark.parametrize("zenith", [5.0, 30.0, 60.0, 80.0])
@pytest.mark.parametrize("azimuth", [0.0, 45.0, 200.0])
def test_diffuse_light_of_a_flash_at_the_lens(zenith: float, azimuth: float) -> None:
    """S0 = ρ cos θ T₊², polarized along the projected normal with DoLP T₋/T₊ (Baek 2018)."""
    c = np.cos(np.radians(zenith))
    plus, minus = fresnel.transmission(c, 1.5)
    phi = 2 * np.radians(azimuth)
    expected = 0.7 * c * plus * np.array([plus, minus * np.cos(phi), minus * np.sin(phi)])
    np.testing.assert_allclose(render(tilted(zenith, azimuth), UP, diffuse=0.7), expected, rtol=1e-6, atol=1e-9)


def test_diffuse_light_vibrates_towards_the_normal_and_reflected_light_across() -> None:
    right, up_right = tilted(50, 0), tilted(50, 45)
    assert render(right, UP, diffuse=1.0)[1] > 0
    assert render(up_right, UP, diffuse=1.0)[2] > 0
    far_right = tilted(100, 0)  # lamp to the right: a facet tilted right by 50° mirrors it
    assert render(right, far_right, specular=0.04)[1] < 0
    assert render(up_right, tilted(100, 45), specular=0.04)[2] < 0


def test_light_mirrored_at_brewsters_angle_is_fully_polarized() -> None:
    brewster = np.degrees(np.arctan(1.5))
    s = render(tilted(brewster), tilted(2 * brewster), specular=0.04)
    assert s[1] / s[0] == pytest.approx(-1.0, abs=1e-9)


def test_highlight_of_a_flash_at_the_lens_is_unpolarized_and_has_its_height() -> None:
    """S0 = π F0 D(1)/4 with D(1) = 1/(π α²)."""
    s = render(UP, UP, specular=0.05, roughness=0.5)
    np.testing.assert_allclose(s, [0.05 / (4 * 0.25**2), 0, 0], atol=1e-9)


def test_what_faces_away_is_dark() -> None:
    assert not render(tilted(60), tilted(170), diffuse=1, specular=0.04).any()
    assert not render(tilted(100), UP, diffuse=1, specular=0.04).any()


def hemisphere(light: np.ndarray, diffuse: float = 0.0, roughness: float = 0.4) -> float:
    """Share of the light on a patch that leaves it: ∫ S0/π cos θ dω over ∫ … of the irradiance.

    The camera is fixed: another outgoing direction is another rotation of normal and light.
    """
    cos_o, phi = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(240) + 0.5) / 240 * 2 * np.pi)
    sin_o = np.sqrt(1 - cos_o**2)
    v = np.stack([sin_o * np.cos(phi), sin_o * np.sin(phi), cos_o], axis=-1)  # about the normal, z
    x = frames.unit(np.cross([0, 1.0, 0], v))
    to_ray = np.stack([x, np.cross(v, x), v], axis=-2)  # rows: the frame on the ray
    normal, light_on_ray = to_ray @ UP, to_ray @ light
    one = np.ones(cos_o.shape)
    color = np.ones((*cos_o.shape, 3))
    s0 = shade.stokes(normal, diffuse * color, 0.04 * color, roughness * one, 1.5 * one, light_on_ray, one)[0, ..., 0]
    return float((s0 * cos_o).mean() * 2 / light[2])  # dω = dcos dφ: mean · 2π/π


@pytest.mark.parametrize("zenith", [0.0, 45.0, 75.0])
def test_no_more_light_leaves_than_came(zenith: float) -> None:
    assert hemisphere(tilted(zenith), diffuse=1.0) < 1.0


@pytest.mark.parametrize("zenith", [20.0, 50.0])
def test_smooth_facets_reflect_fresnels_share(zenith: float) -> None:
    plus, _ = fresnel.reflection(np.cos(np.radians(zenith)), 1.5)
    assert hemisphere(tilted(zenith), roughness=0.35) == pytest.approx(plus, rel=0.03)


def test_torch_and_numpy_agree() -> None:
    torch = pytest.importorskip("torch", reason="the [train] extra is not installed")
    normal, light = tilted(40, 70), tilted(8, 90)
    arrays = (normal, np.full(3, 0.5), np.full(3, 0.04), np.array(0.4), np.array(1.5), light, np.array(1.0))
    tensors = [torch.from_numpy(np.asarray(a)) for a in arrays]
    np.testing.assert_allclose(shade.stokes(*tensors).numpy(), shade.stokes(*arrays), rtol=1e-12)


@pytest.mark.parametrize("light", [tilted(0), tilted(3, 70), tilted(60, 20)])
def test_light_of_two_crossed_axes_is_unpolarized_light(light: np.ndarray) -> None:
    """A flash is as bright with a polarized beam as without: the mean over two crossed axes is the same."""
    for material in ({"diffuse": 0.7}, {"specular": 0.04}):
        normal = tilted(35, 130)
        mean = (render(normal, light, 20, **material) + render(normal, light, 110, **material)) / 2
        tolerance = 0.02 if light[2] < 0.9 else 2e-3  # axes of the picture are not quite crossed across an oblique ray
        np.testing.assert_allclose(mean, render(normal, light, **material), atol=tolerance * abs(mean[0]) + 1e-12)


@pytest.mark.parametrize("axis", [0.0, 30.0, 90.0])
def test_a_mirror_seen_straight_on_keeps_the_axis_of_light(axis: float) -> None:
    s0, s1, s2 = render(tilted(10, 40), UP, axis, specular=0.04)
    assert s0 > 0
    np.testing.assert_allclose([s1, s2], [s0 * np.cos(2 * np.radians(axis)), s0 * np.sin(2 * np.radians(axis))])


@pytest.mark.parametrize("zenith", [0.0, 30.0, 60.0, 75.0])
def test_crossed_filters_show_the_body_alone(zenith: float) -> None:
    """Of light through crossed filters the body's S0 follows, whatever its slope (`optics/crossing.py`)."""
    angle, flash = np.radians(25.0), np.radians(115.0)
    normal = tilted(zenith, 60)
    both = render(normal, UP, np.degrees(flash), diffuse=0.6, specular=0.04)
    seen = 0.5 * (both[0] + both[1] * np.cos(2 * angle) + both[2] * np.sin(2 * angle))
    s0, s1, s2 = render(normal, UP, diffuse=0.6)
    p = crossing.polarization_along(np.array(s1), np.array(s2), angle)
    np.testing.assert_allclose(crossing.diffuse_light(np.array(2 * seen), p), s0, rtol=1e-6)
