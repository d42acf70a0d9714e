"""Training of the mask's network: its pictures follow geometry and optics, the loss falls, the model is exported."""

from pathlib import Path

import numpy as np
import pytest
import torch

from polcap.formats import onnx
from polcap.optics.mesh_tracer import Tracer, smooth
from polcap.stages.mask.mask_channels import CHANNELS, ENCODING
from polcap.training import backdrop_patterns, mask_scenes, mask_train, mask_views, materials, random_shapes

SIZE = (72, 96)


@pytest.fixture(scope="module")
def traced() -> mask_views.MaskView:
    """A ball in front of a wall."""
    unit, faces = random_shapes._sphere(32, 48)
    kind = mask_views.ViewKind("whole", "wall", (0.1, 0.2))
    found = mask_views.trace_view(Tracer(smooth(0.5 * unit, faces)), kind, SIZE, np.random.default_rng(3))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def picture(traced: mask_views.MaskView) -> mask_scenes.MaskScene:
    torch.manual_seed(0)
    library = materials.MaterialLibrary(None, torch.device("cpu"))
    return mask_scenes.make_scene(traced, library, "black", np.random.default_rng(1), charted=0.0)


def test_the_object_touches_no_edge_and_its_shadow_is_opposite_the_flash(traced: mask_views.MaskView) -> None:
    mask = traced.object.mask
    assert mask.any() and not mask[[0, -1]].any() and not mask[:, [0, -1]].any()
    shadow, object_ = (np.argwhere(a).mean(0) for a in (~traced.lit & ~mask, mask))  # row, column
    right, up = shadow[1] - object_[1], object_[0] - shadow[0]
    assert right * traced.flash[0] + up * traced.flash[1] < 0


def test_black_objects_are_black_and_polarization_is_possible(picture: mask_scenes.MaskScene) -> None:
    s0, s1, s2 = picture.stokes.sum(-1)
    assert picture.mask.sum() > 50 and np.isfinite(picture.stokes).all()
    assert np.median(s0[picture.mask]) / 3 < 0.1
    assert (np.hypot(s1, s2) <= s0 * 1.001 + 1e-6).all()


def test_mirroring_negates_s2(tmp_path: Path, picture: mask_scenes.MaskScene) -> None:
    held = mask_train.pack(picture)
    assert held.shape == (36, 48, 7)
    held[..., 3], held[..., 4] = 0.2 * held[..., :3].sum(-1), 0.3 * held[..., :3].sum(-1)
    np.save(tmp_path / "0.npy", held)
    signs = set()
    for seed in range(12):
        varied, truth = mask_train.load_varied(tmp_path / "0.npy", np.random.default_rng(seed))
        _, s1, s2 = (float(part.sum()) for part in varied.stokes)
        as_is = np.array_equal(truth, held[..., 5].astype(np.float32))
        mirrored = np.array_equal(truth, held[:, ::-1, 5].astype(np.float32))
        signs.add((as_is, s2 > 0))
        assert s1 > 0 and (as_is or mirrored or s2 != 0)
    assert (True, True) in signs and (False, False) in signs and (True, False) not in signs


def test_the_network_learns_and_is_exported(tmp_path: Path, picture: mask_scenes.MaskScene) -> None:
    file = tmp_path / "0.npy"
    held = mask_train.pack(picture)
    np.save(file, np.tile(held, (2, 2, 1)))
    run = mask_train.MaskTraining(3e-3, [file])
    losses = [run.advance([file] * 4, 0.0)["loss_whole"] for _ in range(40)]
    assert losses[-1] < 0.9 * losses[0]
    run.export(tmp_path / "mask.onnx", "MIT")
    network = onnx.load(tmp_path / "mask.onnx", threads=1, encoding=ENCODING)
    logit = onnx.run(network, np.zeros((1, len(CHANNELS), 48, 80), np.float32))["logit"]
    assert logit.shape == (1, 1, 48, 80) and network.channels == CHANNELS


def test_loss_is_small_where_the_network_is_right_and_sure() -> None:
    truth = torch.zeros(1, 1, 16, 16)
    truth[..., 4:12, 4:12] = 1
    assert mask_train.mask_loss(20 * (2 * truth - 1), truth) < 1e-3 < mask_train.mask_loss(0 * truth, truth)


def test_an_inserted_object_is_part_of_the_truth(tmp_path: Path, picture: mask_scenes.MaskScene) -> None:
    held = mask_train.pack(picture)
    np.save(tmp_path / "0.npy", held)
    np.save(tmp_path / "1.npy", held[:, ::-1])
    shares = []
    for other in (None, tmp_path / "1.npy"):
        _, truth = mask_train.load_varied(tmp_path / "0.npy", np.random.default_rng(4), other)
        shares.append(truth.mean())
    assert shares[1] >= shares[0] > 0


def test_backdrop_patterns_are_albedos_in_color() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    for seed in range(16):
        albedo = backdrop_patterns.draw_pattern(points, np.random.default_rng(seed))
        assert albedo.shape == (500, 3) and 0 < albedo.min() <= albedo.max() <= 0.95
