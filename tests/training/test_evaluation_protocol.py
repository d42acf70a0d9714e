"""The pictures of the evaluation: complete, each determined by its number, under the stated conditions."""

from pathlib import Path

import numpy as np
import pytest

from polcap.errors import InputError
from polcap.image_values import Floats
from polcap.optics import body, frames
from polcap.training import evaluation_protocol
from polcap.training.evaluation_protocol import Protocol


@pytest.fixture(scope="module")
def made(test_data: Path) -> Protocol:
    return Protocol(test_data, 96)


def test_all_pairs_of_mesh_and_material_come_before_any_repeats() -> None:
    pairs = [evaluation_protocol.combination(k, 6, 30) for k in range(evaluation_protocol.COUNT)]
    assert len(set(pairs[:180])) == 180
    for first in range(0, 240, 30):
        meshes, materials = zip(*pairs[first : first + 30])
        assert sorted(materials) == list(range(30))
        assert all(meshes.count(mesh) == 5 for mesh in range(6))


def test_all_pairs_come_for_other_numbers_of_meshes_and_materials() -> None:
    assert len({evaluation_protocol.combination(k, 4, 22) for k in range(88)}) == 88


def test_a_picture_follows_from_its_number_alone(made: Protocol, test_data: Path) -> None:
    first, _, again = made.case(7), made.case(2), Protocol(test_data, 96).case(7)
    for part in ("radiance", "ratio", "mask"):
        assert np.array_equal(getattr(first.cues, part), getattr(again.cues, part)), part
    assert not np.array_equal(first.truth.normal, made.case(187).truth.normal)  # same pair, other view


def test_object_fills_the_stated_share_of_30_degrees(made: Protocol) -> None:
    for number in range(4):
        truth = made.truth(number, 128)
        assert 2 * np.degrees(np.arctan(64 / truth.view.focal)) == pytest.approx(30)
        y, x = np.nonzero(truth.mask)
        reach = 2 * np.abs(np.concatenate([x, y]) - 63.5).max() / 128
        assert 0.68 < reach < 0.92


def test_clean_cues_carry_the_polarization_of_the_truth(made: Protocol) -> None:
    """Most direct diffuse light is polarized along the normal's azimuth (Fresnel)."""
    case = made.case(3)
    mask = case.truth.mask
    local = frames.to_ray_frame(case.truth.normal[mask], case.clean.rays[mask])
    expected = np.stack([local[:, 0] ** 2 - local[:, 1] ** 2, 2 * local[:, 0] * local[:, 1]])
    tilted = case.clean.dolp[mask] > 0.02
    agreement = np.sum(expected / np.linalg.norm(expected, axis=0) * case.clean.normalized_stokes[:, mask], axis=0)
    assert np.median(agreement[tilted]) > 0.97


def test_diffuse_light_of_the_second_protocol_has_the_dolp_of_rough_interfaces(made: Protocol, test_data: Path) -> None:
    """On equal shapes the DoLP of well lit pixels falls by the ratio of the rough law to the smooth one."""
    second = Protocol(test_data, 96, protocol=2)
    ratios = []
    for number in (2, 3):
        smooth, rough = made.case(number), second.case(number)
        assert np.array_equal(smooth.truth.normal, rough.truth.normal)
        assert np.array_equal(smooth.truth.roughness, rough.truth.roughness)
        local = frames.to_ray_frame(smooth.truth.normal, smooth.clean.rays)
        law = evaluation_protocol.body_law(number)
        alpha = smooth.truth.roughness**2
        expected = law.dolp_factor * body.dolp(np.maximum(local[..., 2], 0.1), alpha, 1.5, law.local)
        expected = expected / body.dolp(np.maximum(local[..., 2], 0.1), 0.0, 1.5)
        tilted = smooth.truth.mask & (smooth.clean.dolp > 0.03) & (local[..., 2] > 0.3)
        found = rough.clean.dolp[tilted] / smooth.clean.dolp[tilted]
        ratios.append(np.median(found - expected[tilted]))
    assert np.abs(ratios).max() < 0.1


def test_f0_of_the_second_protocol_is_that_of_everyday_objects(test_data: Path) -> None:
    second = Protocol(test_data, 96, protocol=2)
    f0 = [float(np.median(second.truth(number, 48).specular[second.truth(number, 48).mask])) for number in range(30)]
    assert 0.035 < np.median(f0) < 0.055 and 2 <= sum(value > 0.06 for value in f0) <= 8


def test_noise_is_that_of_the_stated_camera(made: Protocol) -> None:
    """The RMS of the 1σ of S1/S0 and S2/S0 is 1/√(electrons of a shot); read noise adds a little."""
    case = made.case(3)
    mask = case.truth.mask & (case.cues.radiance.max(-1) < 0.4) & (case.cues.radiance.min(-1) > 0.05)
    electrons = case.cues.radiance[mask].sum(-1) / 2 * 2e4 * (1 / 4 + 1 + 4)  # of three exposures at ratios of 4
    assert 1.0 < np.median(case.cues.ratio_sigma[mask] * np.sqrt(electrons)) < 1.03


def test_binning_keeps_light_and_lowers_noise(test_data: Path) -> None:
    case = Protocol(test_data, 320).case(0)
    assert case.small.mask.shape == (160, 160) and case.small.view.scale == 2
    inner = case.small.mask
    total: Floats = case.cues.radiance[case.cues.mask].sum(axis=0) / 4
    assert case.small.radiance[inner].sum(axis=0) == pytest.approx(total, rel=0.05)
    assert np.median(case.small.ratio_sigma[inner]) < 0.6 * np.median(case.cues.ratio_sigma[case.cues.mask])


def test_missing_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no mesh"):
        Protocol(tmp_path, 96)
