"""Camera noise and errors in training: true Stokes parameters -> those of three imperfect photographs.

Drawn per object: shot and read noise of a merged bracket, with fewer electrons of red and blue light; residual errors
of flash energy, polarizer angle, black level and sensor rows; misregistration, blur, stray light, depolarization,
saturation.
"""

from dataclasses import dataclass, replace
from math import pi

import torch
from torch import Tensor

from polcap.optics import frames

ANGLES = (0.0, pi / 4, pi / 2)  # rad


@dataclass(frozen=True)
class CameraErrors:
    """Errors of the simulated photographs of B objects; all fields (B,) unless noted."""

    full_well: Tensor  # (3, B) electrons of each color at radiance 1 in the middle exposure, which saturates there
    bracket: Tensor  # ratio between neighboring exposures
    read_noise: Tensor  # electrons
    black: Tensor  # (3, 3, B) radiance added to each shot and color
    rows: Tensor  # radiance added to each row of each shot, 1σ
    gain: Tensor  # (3, B) factor on each shot
    angle: Tensor  # (3, B) rad
    shift: Tensor  # (3, B, 2) px
    blur: Tensor  # px, 1σ
    depolarization: Tensor  # factor on S1, S2
    ambient: Tensor  # S0 of a white surface in the stray light
    variance_ratio: Tensor  # stated over true variance

    @staticmethod
    def draw(count: int, device: torch.device) -> "CameraErrors":
        """Draw random camera errors for training."""

        def u(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(*shape, count, device=device)

        def sometimes(share: float) -> Tensor:
            return (u(0, 1) < share).float()

        gain = u(0, 0.005) * torch.randn(3, count, device=device)
        turn_deg = torch.randn(3, count, device=device) * 0.5 + torch.randn(count, device=device) * 0.3
        moved = u(0, 0.1) * sometimes(0.7) * torch.randn(2, 3, count, device=device)
        moved[:, 0] = 0.0
        return CameraErrors(
            full_well=torch.exp(u(9.2, 11.0)) * torch.stack([u(0.35, 1), torch.ones(count, device=device), u(0.35, 1)]),
            bracket=u(1, 5),
            read_noise=u(2, 8),
            black=u(0, 3e-4) * sometimes(0.5) * torch.randn(3, 3, count, device=device),
            rows=u(0, 3e-4) * sometimes(0.3),
            gain=1 + gain,
            angle=turn_deg * pi / 180,
            shift=moved.permute(1, 2, 0),
            blur=u(0, 0.5),
            depolarization=1 - u(0, 0.15) * sometimes(0.3),
            ambient=u(0, 0.03) * sometimes(0.5),
            variance_ratio=torch.exp(0.3 * torch.randn(count, device=device)),
        )

    @staticmethod
    def none(count: int, device: torch.device) -> "CameraErrors":
        """A camera without errors, except for a trace of shot noise."""
        zero, one = torch.zeros(count, device=device), torch.ones(count, device=device)
        return CameraErrors(
            full_well=1e9 * one.expand(3, -1), bracket=1e3 * one, read_noise=zero, black=zero.expand(3, 3, -1),
            rows=zero, gain=one.expand(3, -1), angle=zero.expand(3, -1), shift=torch.zeros(3, count, 2, device=device),
            blur=zero, depolarization=one, ambient=zero, variance_ratio=one,
        )  # fmt: skip

    @staticmethod
    def stated(count: int, device: torch.device) -> "CameraErrors":
        """The camera errors of the evaluation: 20 ke⁻, 5 e⁻, three exposures at ratios of 4, gain 0.3 %, angle 0.5°."""
        return replace(
            CameraErrors.none(count, device),
            full_well=2e4 * torch.ones(3, count, device=device),
            bracket=4 * torch.ones(count, device=device),
            read_noise=5 * torch.ones(count, device=device),
            gain=1 + 0.003 * torch.randn(3, count, device=device),
            angle=torch.randn(3, count, device=device) * 0.5 * pi / 180,
        )


def photograph(
    stokes: Tensor, diffuse: Tensor, mask: Tensor, rays: Tensor, at: Tensor, errors: CameraErrors
) -> tuple[Tensor, Tensor, Tensor]:
    """Simulate three photographs of true Stokes parameters, and measure the Stokes parameters from them.

    stokes (3, B, H, W, 3) are in the frame of each ray; diffuse and rays are (B, H, W, 3), mask (B, H, W); at (M,) are
    indices into B·H·W. Returns measured Stokes parameters (3, M, 3), their covariance (6, M, 3) and clipped pixels
    (M,), all at the pixels `at`. The measurement uses nominal angles in the image, as `stages/stokes` does.
    """
    count, height, width = mask.shape
    per_object = (count, 1, 1, 1)
    owner = at // (height * width)
    inside = mask[..., None].to(stokes.dtype)
    background = torch.rand(count, 1, 1, 3, device=stokes.device) * torch.rand(per_object, device=stokes.device) * 0.3
    s0 = stokes[0] + diffuse * errors.ambient.view(per_object) + (1 - inside) * background
    s1, s2 = (stokes[k] * errors.depolarization.view(per_object) for k in (1, 2))

    shots, variance, clipped = [], [], torch.zeros_like(at, dtype=torch.bool)
    brightest = errors.bracket[owner, None]  # radiance at which the shortest exposure saturates
    for k, angle in enumerate(ANGLES):
        cos, sin = _double_axis((angle + errors.angle[k]).view(count, 1, 1), rays)
        light = (s0 + s1 * cos[..., None] + s2 * sin[..., None]) / 2
        light = _shift_and_blur(light, errors.shift[k], errors.blur).reshape(-1, 3)[at] * errors.gain[k][owner, None]
        light = light + errors.black[k].T[owner]
        if errors.rows.any():  # the evaluation has none, and its other noise is not to depend on them
            light = light + errors.rows[owner, None] * torch.randn(count * height, 1, device=at.device)[at // width]
        clipped = clipped | (light > brightest).any(dim=-1)
        light = torch.minimum(light, brightest)
        true_variance = _merged_variance(light.clamp(min=0), errors, owner)
        shots.append(light + true_variance.sqrt() * torch.randn_like(light))
        variance.append(true_variance * errors.variance_ratio[owner, None])
    i0, i45, i90 = shots
    v0, v45, v90 = variance
    measured = torch.stack([i0 + i90, i0 - i90, 2 * i45 - i0 - i90])
    outer = v0 + v90
    covariance = torch.stack([outer, v0 - v90, -outer, outer, v90 - v0, 4 * v45 + outer])
    return measured, covariance, clipped


def _double_axis(angle: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """cos 2ψ and sin 2ψ of a polarizer's axis ψ on each ray (`frames.axis_on_ray`), without trigonometric functions."""
    x, y = frames.axis_across(angle, rays)
    length = x * x + y * y
    return (x * x - y * y) / length, 2 * x * y / length


def _merged_variance(light: Tensor, errors: CameraErrors, owner: Tensor) -> Tensor:
    """Variance of radiance (M, C) merged from the unsaturated of three exposures, weighted by their times."""
    ratio, read = (x[owner, None] for x in (errors.bracket, errors.read_noise))
    well = errors.full_well.T[owner]
    long, middle = (light * ratio < 1).to(light.dtype), (light < 1).to(light.dtype)  # 1: unsaturated
    time = 1 / ratio + middle + ratio * long
    return light / (well * time) + (read / (well * time)) ** 2 * (1 + middle + long)


def _shift_and_blur(image: Tensor, shift: Tensor, blur: Tensor) -> Tensor:
    """Images (B, H, W, C) shifted by less than a pixel and blurred: three taps per axis, exact to second order."""
    for axis, d in ((2, shift[:, 0]), (1, shift[:, 1])):
        spread = (blur**2 + d**2).view(-1, 1, 1, 1) / 2
        slope = d.view(-1, 1, 1, 1) / 2
        before, after = torch.roll(image, 1, axis), torch.roll(image, -1, axis)
        image = image + spread * (before + after - 2 * image) + slope * (before - after)
    return image
