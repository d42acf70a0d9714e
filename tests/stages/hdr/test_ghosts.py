"""The first estimate is unbiased and smooth where flat; what does not belong is found."""

import numpy as np

from polcap.stages.hdr import ghosts
from polcap.stages.hdr.ghosts import RegisteredFrame
from polcap.stages.hdr.noise import Noise
from polcap.stages.hdr.planes import blocks
from tests.stages.hdr.brackets import planes

WELL = 30000.0
LINE = Noise(np.full(3, 1 / WELL, np.float32), np.full(3, 1e-9, np.float32))
ONE = np.ones(3, np.float32)


def exposed(picture, exposure=1.0, usable=None):
    """A frame (H, W, C) of known exposure and noise."""
    return RegisteredFrame(planes(picture, usable), np.float32(exposure) * ONE, LINE, misfit=0 * ONE)


def shoot(rng, scene, exposure=1.0):
    return (rng.poisson(scene * exposure * WELL) / WELL).astype(np.float32)


def test_first_estimate_is_unbiased_smooth_and_keeps_edges():
    rng = np.random.default_rng(0)
    scene = np.full((200, 300, 3), 0.002)
    scene[:, 150:] = 0.2
    everywhere = np.ones(scene.shape[:2], bool)
    parts = [(exposed(shoot(rng, scene, exposure), exposure), everywhere) for exposure in (0.25, 1, 4)]
    x = np.moveaxis(ghosts.first_estimate(parts, ghosts.Anchor(exposed(scene)), ~everywhere), 0, -1)
    for part in (np.s_[:, 10:140], np.s_[:, 160:290]):
        assert abs(x[part].mean() / scene[part].mean() - 1) < 2e-3
        assert (x[part] - scene[part]).std() < 0.4 * np.sqrt(scene[part].mean() / WELL / 5.25)
    assert np.abs(x[:, 149] - 0.002).max() < 2e-3 and np.abs(x[:, 150] / 0.2 - 1).max() < 0.05


def test_unserved_pixels_take_the_other_value():
    nowhere = np.zeros((20, 20), bool)
    other = ghosts.Anchor(exposed(np.full((20, 20, 3), 7)))
    np.testing.assert_allclose(ghosts.first_estimate([(exposed(np.ones((20, 20, 3))), nowhere)], other, nowhere), 7)


def test_noise_makes_no_ghosts_and_a_mover_does():
    rng = np.random.default_rng(1)
    scene = np.geomspace(0.001, 0.5, 600)[None, :, None] * np.ones((400, 1, 3))
    anchor = ghosts.Anchor(exposed(shoot(rng, scene)))
    quiet = anchor.ghosts(exposed(shoot(rng, scene, 0.25), 0.25))
    assert not quiet.any()
    moved = scene.copy()
    moved[100:130, 400:430] *= 1.4
    found = anchor.ghosts(exposed(shoot(rng, moved, 0.25), 0.25))
    assert found[102:128, 402:428].all()
    found[94:136, 394:436] = False
    assert not found.any()


def test_anchor_takes_the_darkest_frame_where_the_reference_clips():
    rng = np.random.default_rng(2)
    scene = np.full((60, 80, 3), 0.3)
    scene[:, 40:] = 3.0
    clear = np.ones((60, 80), bool)
    clear[:, 38:] = False
    reference = exposed(np.minimum(shoot(rng, scene), 1), usable=clear)
    anchor = ghosts.Anchor(reference, darkest=exposed(shoot(rng, scene, 0.25), 0.25))
    assert anchor.known.all()
    assert abs(anchor.rows(slice(0, 60))[..., 40:].mean() / 3 - 1) < 1e-3
    variance = anchor.variance(scene[..., 0].astype(np.float32), 0, slice(0, 60))
    np.testing.assert_allclose(variance[0, -1], 3 / WELL / 0.25, rtol=1e-3)  # photons of a quarter exposure


def test_blocks_cover_every_row_once_with_their_halo():
    seen = np.zeros(1000, int)
    for rows, inner, target in blocks(1000, 3):
        np.testing.assert_array_equal(np.arange(1000)[rows][inner], np.arange(1000)[target])
        assert rows.start == max(target.start - 3, 0) and rows.stop == min(target.stop + 3, 1000)
        seen[target] += 1
    assert (seen == 1).all()
