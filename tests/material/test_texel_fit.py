"""Normal, albedo, roughness and F0 of texels from nine views, against their truth."""

import numpy as np
import pytest

from polcap.material import gloss_groups, texel_fit, texel_maps
from polcap.material.gloss_groups import LAWS, GlossSettings
from polcap.material.texel_fit import FitSettings, Measurements, TexelEstimate, TexelPrior
from polcap.optics import frames
from tests.material.flat_texels import POLARIZATION_ERROR, RADIANCE_ERROR, materials, measured, views

SETTINGS = FitSettings(RADIANCE_ERROR, POLARIZATION_ERROR)


def prior_of(count: int) -> TexelPrior:
    """A wide prior of the gloss of texels."""
    mean, sigma = (np.tile(np.array(one, np.float32), (count, 1)) for one in ((0.45, 0.042), (0.15, 0.01)))
    return TexelPrior(mean, sigma)


def estimate(count: int, polarization: float = POLARIZATION_ERROR) -> tuple[TexelEstimate, np.ndarray]:
    """Estimates of random texels with a wide prior of their gloss, and the truth."""
    truth, seen = materials(count), views(count)
    data = measured(truth, seen)
    prior = prior_of(count)
    first = texel_fit.start(data, seen, prior, LAWS["smooth"])
    fitted = texel_fit.fit(data, seen, prior, first, LAWS["smooth"], FitSettings(RADIANCE_ERROR, polarization))
    return fitted, truth


def test_nine_views_measure_normals_albedo_and_gloss_of_every_texel() -> None:
    fitted, truth = estimate(600)
    cosine = frames.dot(fitted.normal, texel_fit.normals(truth))
    error = np.sqrt(np.mean((fitted.value - truth) ** 2, axis=0))
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 0.6
    assert error[2] < 0.05 and error[3] < 0.006 and error[4:].max() < 0.006


def test_errors_are_as_large_as_stated() -> None:
    fitted, truth = estimate(600)
    sigma = np.sqrt(np.einsum("nii->ni", np.linalg.inv(fitted.information.astype(float))))
    score = np.sqrt(np.mean(((fitted.value - truth) / sigma) ** 2, axis=0))
    assert score[:4] == pytest.approx(1, rel=0.5)
    assert (score[4:] < 1.3).all()  # three colors with the same error count as three: stated too large


@pytest.mark.parametrize("count", [9, 5])
def test_doubts_follow_the_misfit_where_stated_errors_are_too_large(count: int) -> None:
    """S0 errs by half the stated error, S1 and S2 as stated."""
    truth, every = materials(600), views(600)
    seen, data = every.of_views(range(count)), measured(truth, every)
    data = Measurements(data.radiance[:count], data.polarized[:count], data.noise[:count], data.gray)
    settings, prior = FitSettings(2 * RADIANCE_ERROR, POLARIZATION_ERROR), prior_of(600)
    first = texel_fit.start(data, seen, prior, LAWS["smooth"])
    fitted = texel_fit.fit(data, seen, prior, first, LAWS["smooth"], settings)
    squares, freedom = (one.sum(axis=0) for one in texel_fit.misfit(data, fitted, settings))
    assert np.sqrt(squares / freedom) == pytest.approx([0.55, 1], rel=0.25)  # the priors add to the error of S0
    scale = np.append(squares / freedom, 1)
    sigma = np.sqrt(np.einsum("nki,k->ni", texel_maps.variances(fitted, prior, np.zeros((600, 2))), scale))
    score = np.sqrt(np.mean(((fitted.value - truth) / sigma) ** 2, axis=0))
    assert np.delete(score, texel_fit.ROUGHNESS) == pytest.approx(1, rel=0.4)


def test_polarization_improves_every_value_a_little() -> None:
    """Radiance from nine sides says most: without polarization, errors are 4 to 8 % larger."""
    with_it, without = (
        np.abs(one.value - truth).mean(axis=0) for one, truth in (estimate(600), estimate(600, polarization=1.0))
    )
    assert (with_it < without).all()


def test_a_shadow_in_one_view_is_an_outlier() -> None:
    truth, seen = materials(200), views(200)
    data = measured(truth, seen)
    data.radiance[6] *= 0.4
    prior = prior_of(200)
    first = texel_fit.start(data, seen, prior, LAWS["smooth"])
    fitted = texel_fit.fit(data, seen, prior, first, LAWS["smooth"], SETTINGS)
    cosine = frames.dot(fitted.normal, texel_fit.normals(truth))
    assert np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) < 1.2


@pytest.mark.parametrize(("law", "roughness"), [("smooth", 0.2), ("rough", 0.5)])
def test_a_material_gets_its_own_gloss_and_law(law: str, roughness: float) -> None:
    truth, seen = materials(240), views(240)
    truth[:, 2], truth[:, 3], truth[:, 4:] = roughness, 0.045, [0.4, 0.3, 0.2]
    data = measured(truth, seen, LAWS[law])
    found = gloss_groups.group(data, seen, truth[:, 4:], GlossSettings(materials=1, fitting=SETTINGS))
    assert found.law == law
    assert found.roughness[0] == pytest.approx(roughness, abs=0.02)
    assert found.f0[0] == pytest.approx(0.045, abs=0.004)


def test_a_material_states_errors_that_all_its_texels_share() -> None:
    truth, seen = materials(160), views(160)
    truth[:, 2], truth[:, 3], truth[:, 4:] = 0.7, 0.036, [0.4, 0.3, 0.2]
    data = measured(truth, seen, LAWS["rough"])
    gains = 1 + 0.01 * np.random.default_rng(4).normal(size=len(data.radiance))
    data.radiance[:] *= gains[:, None, None].astype(np.float32)
    found = gloss_groups.group(data, seen, truth[:, 4:], GlossSettings(materials=1, fitting=SETTINGS))
    score = (np.array([found.roughness[0], found.f0[0]]) - [0.7, 0.036]) / found.sigma[0]
    assert np.abs(score).max() < 2 and (found.sigma[0] < [0.1, 0.009]).all()


def test_roughness_of_a_dull_material_is_found_from_five_views() -> None:
    """Without the highlight's flank, roughness 0.2 on other slopes fits nearly as well as 0.6."""
    truth, every = materials(240), views(240)
    truth[:, 2], truth[:, 3], truth[:, 4:] = 0.6, 0.045, [0.5, 0.4, 0.2]
    truth[:, :2] *= 0.6
    data = measured(truth, every)
    data = Measurements(data.radiance[:5], data.polarized[:5], data.noise[:5], data.gray)
    found = gloss_groups.group(
        data, every.of_views(range(5)), truth[:, 4:], GlossSettings(materials=1, fitting=SETTINGS)
    )
    assert found.law == "smooth" and found.roughness[0] == pytest.approx(0.6, abs=0.03)
