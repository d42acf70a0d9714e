"""Training batches have the cues of the stage, and mirrored views keep their geometry."""

import numpy as np
import pytest
import torch

from polcap.image_values import View
from polcap.stages import cues
from polcap.training import evaluation_protocol
from polcap.training.camera_errors import CameraErrors
from polcap.training.simulator import Simulator, channels

CPU = torch.device("cpu")


def test_channels_are_those_of_the_cue_stage(simulator: Simulator) -> None:
    views = simulator.gather(np.array([3]), 64, flip=False)
    photo = simulator.photograph(views, torch.ones(1), CameraErrors.stated(1, CPU))
    ours = channels(photo)[0].numpy()
    focal, x, y = (float(a) for a in simulator.camera[3, :3])
    measured = (photo.stokes, photo.covariance, photo.clipped)
    image = evaluation_protocol.stokes_image(measured, photo.input_mask[0].numpy(), View(focal, (x, y), 1.0))
    theirs = cues.channels(cues.compute(image, evaluation_protocol.white()))
    np.testing.assert_allclose(ours, theirs, atol=2e-4)  # float32 in another order; arccos near 1 is touchy


@pytest.mark.parametrize("seed", range(6))
def test_mirrored_views_are_still_views_of_the_object(simulator: Simulator, seed: int) -> None:
    """Camera-frame points turned back to the object's frame differ from its positions by one translation."""
    torch.manual_seed(seed)
    pick = np.array([0, 7])
    mirrored, original = (simulator.gather(pick, 64, flip=flip) for flip in (True, False))
    pixels = mirrored.pixels
    middle = torch.from_numpy(simulator.camera[pick, 3])[pixels.owner]
    turn = mirrored.turn[pixels.owner]
    back = torch.einsum("mji,mj->mi", turn, pixels.place * middle[:, None]) - pixels.position
    for k in range(2):
        assert back[pixels.owner == k].std(dim=0).max() < 2e-3  # fp16
    turned = [
        torch.einsum("mji,mj->mi", v.turn[v.pixels.owner], v.pixels.normal).sum(dim=0) for v in (mirrored, original)
    ]
    torch.testing.assert_close(*turned, atol=1e-2, rtol=1e-4)
    flash = [torch.einsum("bji,bj->bi", v.turn, v.flash) for v in (mirrored, original)]
    torch.testing.assert_close(*flash)


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("size", [32, 64])
def test_pixels_that_see_each_other_face_each_other(simulator: Simulator, size: int, flip: bool) -> None:
    """Rays leave and arrive on the outside of the surface, at any size, mirrored or not."""
    torch.manual_seed(3)
    seen = simulator.gather(np.arange(12), size, flip=flip).pixels
    here, ray = (seen.met >= 0).nonzero(as_tuple=True)
    there = seen.met[here, ray]
    assert len(here) > 100 and (seen.owner[here] == seen.owner[there]).all()
    direction = seen.place[there] - seen.place[here]
    far = direction.norm(dim=1) > 6 / size  # nearer ones are decided by the grid
    leaves = (direction * seen.normal[here]).sum(dim=1)[far] > 0
    arrives = (direction * seen.normal[there]).sum(dim=1)[far] < 0
    assert leaves.float().mean() > 0.85 and arrives.float().mean() > 0.85  # of a wrong pixel: half


@pytest.mark.parametrize("size", [32, 64])
def test_batch_is_finite_empty_outside_and_follows_from_the_seed(simulator: Simulator, size: int) -> None:
    torch.manual_seed(1)
    batch = simulator.draw_batch(5, size)
    torch.manual_seed(1)
    assert torch.equal(batch.channels, simulator.draw_batch(5, size).channels)
    assert batch.channels.shape == (5, len(cues.CHANNELS), size, size) and batch.channels.isfinite().all()
    outside = batch.channels[:, cues.CHANNELS.index("mask")] == 0
    assert (batch.channels.abs().sum(dim=1)[outside] == 0).all()
    for name in ("normal", "depth", "diffuse", "specular", "roughness"):
        assert getattr(batch, name).isfinite().all()
    length = batch.normal.norm(dim=1)[batch.mask]
    torch.testing.assert_close(length, torch.ones_like(length))
    assert batch.normal[:, 2][batch.mask].min() > 0
    assert batch.diffuse.min() >= 0 and batch.diffuse.max() <= 1 and batch.specular.max() <= 0.4
