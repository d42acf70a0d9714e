"""Gloss profiles of a rendered ball follow the reflection law."""

from pathlib import Path

import numpy as np
import pytest
import torch

from polcap.optics import brdf, fresnel, shade
from polcap.stages.cues import NOMINAL_IOR
from polcap.training import gloss_profiles

DIFFUSE, F0, ROUGHNESS = 0.4, 0.06, 0.5


def ball(side: int = 96) -> tuple[torch.Tensor, torch.Tensor]:
    """Normals (1, 3, H, W) of a sphere seen along the axis, and its mask (1, 1, H, W)."""
    x = torch.linspace(-1, 1, side)
    y, x = torch.meshgrid(x, x, indexing="ij")
    z = (1 - x * x - y * y).clamp(min=0).sqrt()
    return torch.stack([x, y, z])[None], (z > 0.05).float()[None, None]


def profile(specular: float) -> torch.Tensor:
    """(bins, figures) of the ball as one group."""
    normal, inside = ball()
    flat = normal[0].permute(1, 2, 0)
    one = torch.ones(flat.shape[:2])
    light = torch.zeros_like(flat) + torch.tensor([0.0, 0, 1])
    white = torch.ones_like(flat)
    stokes = shade.stokes(flat, DIFFUSE * white, specular * white, ROUGHNESS * one, NOMINAL_IOR * one, light, one)
    level = torch.log(stokes[0] + 0.02).permute(2, 0, 1)[None]
    ratio = (stokes[1:].sum(-1) / stokes[0].sum(-1).clamp(min=1e-6))[None]
    figures = gloss_profiles.figures_of(level, ratio, normal, torch.full_like(normal, DIFFUSE))
    table = gloss_profiles.profile(inside.flatten(2), (figures * inside).flatten(2), normal[:, 2:].flatten(2))
    return table.reshape(gloss_profiles._BINS, gloss_profiles._FIGURES)


def test_a_matte_ball_has_no_excess_light_and_no_missing_polarization() -> None:
    table = profile(0.0)
    assert table[:8, 2].abs().max() < 0.05  # excess
    assert table[7:, 5].abs().max() < 0.12  # missing DoLP, at zeniths where diffuse light is polarized


def test_excess_light_at_normal_incidence_is_the_specular_lobe() -> None:
    """ln(1 + F0 π D G/(4 cos) / (ρ cos T₊²)) at normal incidence, from the textbook formulas alone."""
    alpha = ROUGHNESS**2
    lobe = np.pi * (1 / (np.pi * alpha**2)) / 4
    body = DIFFUSE * 0.96**2
    expected = np.log(1 + F0 * lobe / body)
    assert abs(brdf.ggx_distribution(1.0, alpha) * np.pi / 4 - lobe) < 1e-9 * lobe
    assert abs(fresnel.transmission(1.0, NOMINAL_IOR)[0] - 0.96) < 1e-6
    found = profile(F0)[:, 2]
    assert abs(float(found[0]) - expected) < 0.15 * expected  # the bin reaches to 4°, where the lobe has fallen
    assert float(found[0]) > float(found[1]) > float(found[2]) > float(found[4])


class ProfileModel(torch.nn.Module):  # type: ignore[misc]
    """`profile` as a model of its own: 14 channels are the groups, the figures and the cosine."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        weight, figures, cosine = x.flatten(2).split((8, 5, 1), dim=1)
        return gloss_profiles.profile(weight.sigmoid(), figures, cosine)


def test_exported_sums_are_the_same_whatever_the_number_of_threads(tmp_path: Path) -> None:
    ort = pytest.importorskip("onnxruntime")
    inputs = torch.rand(1, 14, 128, 112)
    file = tmp_path / "profile.onnx"
    torch.onnx.export(ProfileModel(), (inputs,), str(file), opset_version=17, dynamo=False)
    found = []
    for threads in (1, 2, 3):
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        session = ort.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        found.append(session.run(None, {session.get_inputs()[0].name: inputs.numpy()})[0].tobytes())
    assert found[0] == found[1] == found[2]
