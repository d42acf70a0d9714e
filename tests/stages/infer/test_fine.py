"""The refinement network adds fine relief only; tiles leave no seams; other networks are refused."""

import dataclasses

import numpy as np
import pytest

from polcap.errors import ModelError
from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.pipeline import models
from polcap.stage_values import Cues
from polcap.stages.infer import fine
from tests.fake_network import FakeNetwork, run

SIDE = 300
RNG = np.random.default_rng(1)


@pytest.fixture
def seen() -> Cues:
    mask = np.zeros((SIDE, SIDE), bool)
    mask[10:-10, 20:-5] = True
    view = View(focal=900.0, center=(SIDE / 2, SIDE / 2), scale=1.0)
    flat = np.zeros((SIDE, SIDE), np.float32)
    return Cues(
        radiance=RNG.uniform(0.1, 0.5, (SIDE, SIDE, 3)).astype(np.float32), ratio=np.stack([flat, flat]),
        ratio_sigma=flat + 0.01, dolp=flat, normalized_stokes=np.stack([flat, flat]),
        diffuse_color=np.zeros((SIDE, SIDE, 3), np.float32), rays=frames.rays(view, SIDE, SIDE), mask=mask,
        quality=np.zeros((SIDE, SIDE), np.uint8), view=view,
    )  # fmt: skip


@pytest.fixture
def guess(seen: Cues) -> fine.CoarseEstimate:
    return fine.CoarseEstimate(seen.rays, seen.rays, np.full((SIDE, SIDE), 5.0), np.full((SIDE, SIDE), 0.4), 2.0)


def network(relief: Floats | None = None) -> FakeNetwork:
    """A network that answers with a relief, or with the brightness of each pixel as one to the right."""

    def answer(channels: Floats) -> dict[str, Floats]:
        first = channels[:, :1]
        return {"relief": np.concatenate([first, 0 * first, 0 * first], axis=1) if relief is None else relief}

    return FakeNetwork("0" * 32, fine.CHANNELS, {"native_size": "256", "size_multiple": "8"}, answer=answer)


def test_tiles_leave_no_seam(seen: Cues, guess: fine.CoarseEstimate, monkeypatch: pytest.MonkeyPatch) -> None:
    """The margin of a tile covers nearly all that the shipped network sees."""
    found = models.load_network("network", None, "cpu", 1)
    assert found is not None and found.fine is not None
    whole = fine.refine(seen, guess, found.fine, run)
    monkeypatch.setattr(fine, "_TILE", 64)
    assert np.abs(fine.refine(seen, guess, found.fine, run) - whole).max() < 1e-3


def test_relief_moves_the_normals(seen: Cues, guess: fine.CoarseEstimate, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fine, "_TILE", 128)
    normal = fine.refine(seen, guess, network(), run)
    whole = fine.high_pass(np.stack([fine.encode(seen, guess)[0], *np.zeros((2, SIDE, SIDE))], -1), seen.mask, 2.0)
    local = frames.to_ray_frame(normal, seen.rays)
    moved = (local[..., 0] / local[..., 2])[seen.mask]
    assert np.abs(moved - whole[..., 0][seen.mask]).max() < 1e-5 and moved.std() > 0.1
    assert np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)


def test_what_is_coarser_than_the_first_network_sees_is_not_added(seen: Cues, guess: fine.CoarseEstimate) -> None:
    slope = np.linspace(-1, 1, SIDE, dtype=np.float32)[None, :, None] * np.ones((SIDE, 1, 3), np.float32)
    left = fine.high_pass(slope, seen.mask, 2.0)
    inner = left[40:-40, 50:-40]
    assert np.abs(inner).max() < 0.01 and not left[~seen.mask].any()
    wave = np.sin(np.arange(SIDE) * 2 * np.pi / 6).astype(np.float32)[None, :, None] * np.ones((SIDE, 1, 3), np.float32)
    assert np.abs(fine.high_pass(wave, seen.mask, 2.0) - wave)[40:-40, 50:-40].max() < 0.05


def test_a_network_of_other_channels_or_maps_is_refused(seen: Cues, guess: fine.CoarseEstimate) -> None:
    with pytest.raises(ModelError, match="expects channels red"):
        fine.refine(seen, guess, dataclasses.replace(network(), channels=("red",)), run)
    with pytest.raises(ModelError, match="this version needs"):
        fine.refine(seen, guess, network(np.zeros((1, 1, SIDE, SIDE), np.float32)), run)
