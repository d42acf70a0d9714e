"""Normal, albedo, roughness and F0 of texels from nine views, against their truth."""

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.material import gloss_groups, texel_fit, texel_maps
from polcap.material.gloss_groups import LAWS, GlossSettings
from polcap.material.texel_fit import FitSettings, Measurements, TexelEstimate, TexelPrior
from polcap.material.texel_grid import TexelViews
from polcap.optics import frames
from tests.material.flat_texels import POLARIZATION_ERROR, RADIANCE_ERROR, first_views, materials, measured, views

SETTINGS = FitSettings(RADIANCE_ERROR, POLARIZATION_ERROR)
ONE = GlossSettings(materials=1, fitting=SETTINGS)
TRUTH, SEEN = materials(600), views(600)
PRIOR = TexelPrior.alike((0.45, 0.042), (0.15, 0.01), 600)  # wide


def estimate(data: Measurements, seen: TexelViews = SEEN, settings: FitSettings = SETTINGS) -> TexelEstimate:
    first = texel_fit.start(data, seen, PRIOR, LAWS["smooth"])
    return texel_fit.fit(data, seen, PRIOR, first, LAWS["smooth"], settings)


@pytest.fixture(scope="module")
def fitted() -> TexelEstimate:
    return estimate(measured(TRUTH, SEEN))


def test_nine_views_measure_normals_albedo_and_gloss_of_every_texel(fitted: TexelEstimate) -> None:
    error = np.sqrt(np.mean((fitted.value - TRUTH) ** 2, axis=0))
    assert frames.angle_deg(fitted.normal, texel_fit.normals(TRUTH)).mean() < 0.6
    assert error[2] < 0.05 and error[3] < 0.006 and error[4:].max() < 0.006


def test_errors_are_as_large_as_stated(fitted: TexelEstimate) -> None:
    sigma = np.sqrt(np.einsum("nii->ni", np.linalg.inv(fitted.information.astype(float))))
    score = np.sqrt(np.mean(((fitted.value - TRUTH) / sigma) ** 2, axis=0))
    assert score[:4] == pytest.approx(1, rel=0.5)
    assert (score[4:] < 1.3).all()  # three colors with the same error count as three: stated too large


@pytest.mark.parametrize("count", [9, 5])
def test_doubts_follow_the_misfit_where_stated_errors_are_too_large(count: int) -> None:
    """S0 errs by half the stated error, S1 and S2 as stated."""
    data, seen = first_views(count, measured(TRUTH, SEEN), SEEN)
    settings = FitSettings(2 * RADIANCE_ERROR, POLARIZATION_ERROR)
    fitted = estimate(data, seen, settings)
    squares, freedom = (one.sum(axis=0) for one in texel_fit.misfit(data, fitted, settings))
    assert np.sqrt(squares / freedom) == pytest.approx([0.55, 1], rel=0.25)  # the priors add to the error of S0
    scale = np.append(squares / freedom, 1)
    sigma = np.sqrt(np.einsum("nki,k->ni", texel_maps.variances(fitted, PRIOR, np.zeros((600, 2))), scale))
    score = np.sqrt(np.mean(((fitted.value - TRUTH) / sigma) ** 2, axis=0))
    assert np.delete(score, texel_fit.ROUGHNESS) == pytest.approx(1, rel=0.4)


def test_polarization_improves_every_value_a_little(fitted: TexelEstimate) -> None:
    """Radiance from nine sides gives most: without polarization, errors are 4 to 8 % larger."""
    blind = estimate(measured(TRUTH, SEEN), settings=FitSettings(RADIANCE_ERROR, 1.0))
    with_it, without = (np.abs(one.value - TRUTH).mean(axis=0) for one in (fitted, blind))
    assert (with_it < without).all()


def test_a_shadow_in_one_view_is_an_outlier() -> None:
    data = measured(TRUTH, SEEN)
    data.radiance[6] *= 0.4
    assert np.median(frames.angle_deg(estimate(data).normal, texel_fit.normals(TRUTH))) < 1.2


def uniform(count: int, roughness: float, f0: float, albedo: tuple[float, float, float]) -> Floats:
    """Values (N, 7) of texels of one material on random slopes."""
    truth = materials(count)
    truth[:, 2:] = roughness, f0, *albedo
    return truth


@pytest.mark.parametrize(("law", "roughness"), [("smooth", 0.2), ("rough", 0.5)])
def test_a_material_gets_its_own_gloss_and_law(law: str, roughness: float) -> None:
    truth, seen = uniform(240, roughness, 0.045, (0.4, 0.3, 0.2)), views(240)
    found = gloss_groups.group(measured(truth, seen, LAWS[law]), seen, truth[:, 4:], ONE)
    assert found.law == law
    assert found.roughness[0] == pytest.approx(roughness, abs=0.02)
    assert found.f0[0] == pytest.approx(0.045, abs=0.004)


def test_a_material_states_errors_that_all_its_texels_share() -> None:
    truth, seen = uniform(160, 0.7, 0.036, (0.4, 0.3, 0.2)), views(160)
    data = measured(truth, seen, LAWS["rough"])
    gains = 1 + 0.01 * np.random.default_rng(4).normal(size=len(data.radiance))
    data.radiance[:] *= gains[:, None, None].astype(np.float32)
    found = gloss_groups.group(data, seen, truth[:, 4:], ONE)
    score = (np.array([found.roughness[0], found.f0[0]]) - [0.7, 0.036]) / found.sigma[0]
    assert np.abs(score).max() < 2 and (found.sigma[0] < [0.1, 0.009]).all()


def test_roughness_of_a_dull_material_is_found_from_five_views() -> None:
    """Without the highlight's flank, roughness 0.2 on other slopes fits nearly as well as 0.6."""
    truth = uniform(240, 0.6, 0.045, (0.5, 0.4, 0.2))
    truth[:, :2] *= 0.6
    found = gloss_groups.group(*first_views(5, measured(truth, views(240)), views(240)), truth[:, 4:], ONE)
    assert found.law == "smooth" and found.roughness[0] == pytest.approx(0.6, abs=0.03)
