"""Every kind of sensor gives the same light: Bayer binned or interpolated, X-Trans, monochrome, finished pictures."""

import numpy as np
import pytest
from msgspec import structs
from scipy.ndimage import gaussian_filter

from polcap.errors import CaptureError
from polcap.formats.capture import reader as captures
from polcap.formats.raw import frame_decoder
from polcap.image_values import Quality, SensorImage
from polcap.stages import hdr
from polcap.synth import shooting
from polcap.synth.scenes import random_scene
from tests.stages.hdr.brackets import (
    BLACK,
    GAIN,
    READ,
    RGGB,
    WHITE,
    bracket,
    capture,
    check_errors,
    electrons_to_signal,
    frame,
    merge,
    ramp,
    record,
    through_filter,
)


def test_view_is_that_of_the_binned_grid():
    frames, _, _ = bracket(ramp(192, 288), [(1, 100)])
    view = merge(capture(frames)).view
    assert (view.scale, view.focal, view.center) == (2, 500, (50.0, 40.0))


def test_full_size_keeps_bias_and_variance_honest():
    y, x = np.mgrid[:512, :640]
    light = (400 * np.exp(x / 160) * (1 + 0.1 * np.sin(y / 40)))[..., None] * np.array([0.6, 1.0, 0.7])
    rng, mosaic = np.random.default_rng(5), through_filter(light)
    frames = [frame(record(mosaic * e, rng), iso=100.0) for e in (0.25, 1, 4)]
    stack = merge(capture(frames), demosaic="full")
    assert stack.value.shape == (1, 512, 640, 3)
    assert (stack.view.scale, stack.view.focal, stack.view.center) == (1, 1000, (100.5, 80.5))
    inner = np.s_[4:-4, 4:-4]
    z = ((stack.value[0] - electrons_to_signal(light)) / np.sqrt(stack.variance[0]))[inner]
    clear = (stack.quality[0][inner] & Quality.CLIPPED) == 0
    assert abs(z[clear].mean()) < 0.05
    assert abs(z[clear].var() - 1) < 0.1


def test_photosites_of_the_first_shot_are_merged_without_the_frame_that_moved():
    """Light that differs from photosite to photosite, which superpixels do not show."""
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:320, :400]
    blobs = gaussian_filter(rng.normal(size=x.shape), 5)
    light = 900 * np.exp(0.3 * blobs / blobs.std()) * (1 + 0.05 * np.sin(2.2 * x) * np.cos(1.9 * y))
    light = through_filter(light[..., None] * np.array([0.6, 1.0, 0.7]))
    exposed = ((0.25, 0), (1, 0), (4, 8))  # exposure, and px by which the frame moved
    frames = [frame(record(np.roll(light, moved, 1) * e, rng), iso=100.0) for e, moved in exposed]
    stack = merge(capture(frames, frames))
    assert np.array_equal(stack.mosaic.cfa, RGGB) and stack.mosaic.value.shape == light.shape
    exposure = 1.25  # of the two frames that did not move
    variance = (light * exposure + 2 * (READ**2 + GAIN**2 / 12)) / exposure**2
    z = (stack.mosaic.value - electrons_to_signal(light)) / electrons_to_signal(np.sqrt(variance))
    assert abs(z[:, 20:-20].mean()) < 0.05
    assert abs(z[:, 20:-20].var() - 1) < 0.05


def test_x_trans_brackets_give_the_light_of_a_bayer_camera(tmp_path):
    """The same scene through both mosaics: S0 of each channel alike within noise, three RAW px per px."""
    shoot = shooting.Shoot(seed=3, width=312, height=234, nudge_px=0.0, nudge_deg=0.0, gain_jitter=0.0, samples=1)
    merged = {}
    for cfa in ("RGGB", "X-Trans"):
        shooting.write(tmp_path / cfa, random_scene(3, "bumps"), structs.replace(shoot, cfa=cfa))
        capture = captures.read(tmp_path / cfa)
        merged[cfa] = hdr.merge(capture, frame_decoder.decode, hdr.HdrSettings())
        if cfa == "X-Trans":
            with pytest.raises(CaptureError, match="X-Trans"):
                hdr.merge(capture, frame_decoder.decode, hdr.HdrSettings(demosaic="full"))
    bayer, x_trans = merged.values()
    assert x_trans.view.scale == 3 and x_trans.value.shape == (3, 78, 104, 3)
    assert x_trans.view.focal == pytest.approx(bayer.view.focal * 2 / 3)
    # 12 RAW px a side: six Bayer quads, four X-Trans blocks
    one, other = (
        m.value[:, : 19 * n, : 26 * n].reshape(3, 19, n, 26, n, 3).mean((2, 4)) for m, n in ((bayer, 6), (x_trans, 4))
    )
    bright = one.min((0, 3)) > 0.02
    assert bright.sum() > 50
    assert np.median(np.abs(other / one - 1)[:, bright]) < 0.02  # texture is sampled at other sites
    assert np.abs(np.median((other / one)[:, bright], axis=1) - 1).max() < 0.01  # no channel is off


def test_monochrome_channel_becomes_three_with_three_times_the_variance():
    """So that the sum over channels, and its variance, is that of three independent ones."""
    rng = np.random.default_rng(13)
    light = np.repeat(np.exp(np.linspace(5, 9, 400))[None], 300, 0)

    def shoot(exposure):
        gray = np.clip(np.round(rng.poisson(light * exposure) / GAIN + BLACK), 0, WHITE).astype(np.uint16)
        return SensorImage(np.repeat(gray[..., None], 3, 2), np.full((1, 1), BLACK), WHITE, None)

    stack = merge(capture([frame(shoot(e), iso=100.0) for e in (0.5, 1, 2)]))
    assert stack.value.shape == (1, 300, 400, 3)
    assert (stack.view.scale, stack.view.center) == (1, (100.5, 80.5))
    total = stack.value[0].mean(axis=2) - electrons_to_signal(light)
    z = total / np.sqrt(stack.variance[0].sum(axis=2) / 9)
    assert abs(z.mean()) < 0.05
    assert abs(z.var() - 1) < 0.1


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("order", [(0.5, 1, 80), (80, 1, 0.5)])
def test_wholly_clipped_frame_has_the_channels_of_the_others(channels, order):
    """Its three channels are alike whatever they are of."""
    color = [0.6, 1, 0.7] if channels == 3 else [1, 1, 1]
    light = np.exp(np.linspace(5, 9, 120))[None, :, None] * np.ones((90, 1, 3)) * color / 2e4
    noise = 1 + np.random.default_rng(2).normal(scale=0.002, size=(90, 120, 1))
    pictures = [np.minimum(light * noise * e + (e > 9), 1).astype(np.float32) for e in order]
    frames = [
        frame(SensorImage(value, np.zeros((1, 1)), 1.0, None), exposure_time=e) for value, e in zip(pictures, order)
    ]
    assert (frames[order.index(80)].load().value == 1).all()
    stack = merge(capture(frames))
    assert stack.value.shape == (1, 90, 120, 3) and np.isfinite(stack.value).all()


def test_three_channel_frames_pass_unbinned_and_lossy_is_reported():
    rng = np.random.default_rng(15)
    light = np.exp(np.linspace(5, 9, 300))[None, :, None] * np.ones((200, 1, 3)) * [0.6, 1, 0.7]
    frames = [
        frame(SensorImage(rng.poisson(light * e).astype(np.float32) / 2e4, np.zeros((1, 1)), 1.0, None, lossy=e == 1))
        for e in (0.5, 1, 2)
    ]
    stack = merge(capture(frames))
    assert stack.value.shape == (1, 200, 300, 3) and stack.sensor.lossy
    check_errors(stack, light / 2e4)
