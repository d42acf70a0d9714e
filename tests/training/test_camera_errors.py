"""The simulated camera of training follows Malus's law, and its noise has the stated variance."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from polcap.optics import frames
from polcap.training.camera_errors import CameraErrors, photograph

CPU = torch.device("cpu")
B, S = 2, 48


def scene(s1: float = 0.05, s2: float = -0.03) -> tuple[Tensor, ...]:
    stokes = torch.zeros(3, B, S, S, 3)
    stokes[0], stokes[1], stokes[2] = 0.5, 0.5 * s1, 0.5 * s2
    rays = torch.zeros(B, S, S, 3)
    rays[..., 2] = 1
    return stokes, torch.full((B, S, S, 3), 0.4), torch.ones(B, S, S, dtype=torch.bool), rays


def shoot(
    errors: CameraErrors, stokes: Tensor, diffuse: Tensor, mask: Tensor, rays: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    return photograph(stokes, diffuse, mask, rays, torch.arange(B * S * S), errors)


def test_perfect_camera_returns_the_stokes_parameters() -> None:
    images = scene()
    measured, _, clipped = shoot(CameraErrors.none(B, CPU), *images)
    torch.testing.assert_close(measured, images[0].reshape(3, -1, 3), atol=3e-4, rtol=0)  # 1e9 electrons
    assert not clipped.any()


def test_polarizer_angles_are_projected_on_oblique_rays() -> None:
    """Light polarized along the axis at 45°, projected across an oblique ray, passes completely."""
    stokes, diffuse, mask, _ = scene()
    rays = torch.nn.functional.normalize(torch.tensor([0.2, 0.15, 1.0]), dim=0).expand(B, S, S, 3)
    axis = frames.axis_on_ray(torch.tensor(torch.pi / 4), rays)
    stokes[1], stokes[2] = (0.5 * f(2 * axis)[..., None] for f in (torch.cos, torch.sin))
    measured, _, _ = shoot(CameraErrors.none(B, CPU), stokes, diffuse, mask, rays)
    through_45 = (measured[0] + measured[2]) / 2
    assert (through_45 - 0.5).abs().max() < 2e-4  # 9σ of the remaining noise


def test_noise_has_the_variance_it_states() -> None:
    images = scene()
    errors = replace(CameraErrors.none(B, CPU), full_well=torch.full((3, B), 2e4), read_noise=torch.full((B,), 5.0))
    errors = replace(errors, bracket=torch.full((B,), 3.0))
    measured, covariance, _ = shoot(errors, *images)
    difference = measured - images[0].reshape(3, -1, 3)
    for k, place in ((0, 0), (1, 3), (2, 5)):
        z = difference[k] / covariance[place].sqrt()
        assert abs(float(z.mean())) < 0.05 and float(z.std()) == pytest.approx(1, abs=0.03)
    product = (difference[0] * difference[2]).mean() / covariance[2].mean()
    assert float(product) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("axis", [0, 1])
def test_shift_moves_a_ramp_by_its_length(axis: int) -> None:
    stokes, *rest = scene(0, 0)
    ramp = torch.arange(S) * 0.01
    stokes[0] = ramp[None, None, :, None] if axis == 0 else ramp[None, :, None, None]
    none = CameraErrors.none(B, CPU)
    shift = torch.zeros(3, B, 2)
    shift[:, :, axis] = 0.1
    measured, _, _ = shoot(replace(none, shift=shift), stokes, *rest)
    moved = (measured[0].reshape(B, S, S, 3) - stokes[0])[:, 8:-8, 8:-8]
    assert (moved + 0.001).abs().max() < 1e-4


def test_saturation_is_flagged_and_stays_finite() -> None:
    stokes, *rest = scene()
    stokes[:, 0] *= 20
    errors = replace(CameraErrors.none(B, CPU), bracket=torch.full((B,), 4.0))
    measured, _, clipped = shoot(errors, stokes, *rest)
    assert clipped[: S * S].all() and not clipped[S * S :].any() and measured.isfinite().all()


def test_noise_is_that_of_each_color() -> None:
    """A channel with a quarter of the electrons has twice the shot noise, and says so in its variance."""
    images = scene()
    well = torch.tensor([5e3, 2e4, 2e4])[:, None].expand(3, B)
    measured, covariance, _ = shoot(replace(CameraErrors.none(B, CPU), full_well=well), *images)
    spread = (measured[0] - images[0].reshape(3, -1, 3)[0]).std(dim=0)
    assert float(spread[0] / spread[1]) == pytest.approx(2, abs=0.06)
    assert float(spread[1] / spread[2]) == pytest.approx(1, abs=0.03)
    torch.testing.assert_close(covariance[0].mean(dim=0).sqrt(), spread, rtol=0.03, atol=0)


def test_black_level_moves_whole_shots_and_row_noise_whole_rows() -> None:
    images, none = scene(), CameraErrors.none(B, CPU)
    black = torch.zeros(3, 3, B)
    black[2, 0] = 0.01  # red of the shot at 90°
    measured, _, _ = shoot(replace(none, black=black), *images)
    moved = (measured - images[0].reshape(3, -1, 3)).mean(dim=1)
    expected = torch.zeros(3, 3)
    expected[:, 0] = torch.tensor([0.01, -0.01, -0.01])
    torch.testing.assert_close(moved, expected, atol=1e-5, rtol=0)
    measured, _, _ = shoot(replace(none, rows=torch.full((B,), 0.01)), *images)
    error = (measured[0] - images[0].reshape(3, -1, 3)[0]).reshape(B, S, S, 3)
    assert float(error.std(dim=2).max()) < 3e-4 and float(error.mean(dim=(2, 3)).std()) == pytest.approx(0.014, rel=0.3)
