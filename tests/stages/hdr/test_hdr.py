"""The merge is unbiased down to the dark, knows its own variance, and says where it cannot know."""

import json
import os
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from polcap.errors import CaptureError, SettingError
from polcap.formats import capture as captures
from polcap.images import Capture, Exif, Frame, Quality, SensorImage, Shot
from polcap.optics.robust import MAD_TO_SIGMA
from polcap.stages import hdr
from polcap.stages.hdr import budget, links, noise
from polcap.stages.hdr import ghosts as bracket_pixels
from polcap.stages.hdr.planes import Reader, signals
from polcap.synth import shooting

RGGB = np.array([[0, 1], [1, 2]], np.uint8)
BLACK, WHITE, READ, GAIN = 512.0, 15871.0, 3.0, 2.0  # counts, counts, e⁻, e⁻ per count at ISO 100


def ramp(height, width, low=20.0, high=1.2e5, ripple=0.2):
    """Expected electrons (h, w, 3) of the quads at exposure 1, from deep shadow to far beyond the well."""
    y, x = np.mgrid[: height // 2, : width // 2]
    level = np.exp(np.interp(x, [0, width // 2], [np.log(low), np.log(high)]))
    level = level * (1 + ripple * np.sin(x / 7) * np.sin(y / 5))
    return level[..., None] * np.array([0.6, 1.0, 0.7])


def expose(quads, exposure, rng, iso=100.0):
    """One mosaic frame: Poisson light, read noise, gain of the ISO, rounding, clipping."""
    light = np.empty((2 * quads.shape[0], 2 * quads.shape[1]))
    for i, j in np.ndindex(2, 2):
        light[i::2, j::2] = quads[..., RGGB[i, j]] * exposure
    counts = (rng.poisson(light) + rng.normal(0, READ, light.shape)) / (GAIN * 100 / iso) + BLACK
    value = np.clip(np.round(counts), 0, WHITE).astype(np.uint16)
    value.setflags(write=False)
    return SensorImage(value, np.full((2, 2), BLACK), WHITE, RGGB)


def frame(image, **exif):
    stated = exif.pop("exposure", None)
    return Frame("x.dng", Exif(**exif), "shot", "", lambda: image, exposure=stated)


def capture(*shots, ambient=()):
    return Capture(
        "test", "", tuple(Shot(np.pi / 4 * k, tuple(s), tuple(ambient)) for k, s in enumerate(shots)),
        "folders", 1000.0, True, (100.5, 80.5), (1, 1),
    )  # fmt: skip


def scores(stack, truth, shot=0):
    """z of the pixels that are not clipped, (N, 3)."""
    clear = (stack.quality[shot] & Quality.CLIPPED) == 0
    return ((stack.value[shot] - truth) / np.sqrt(stack.variance[shot]))[clear]


def electrons_to_signal(electrons, iso=100.0):
    return electrons / (GAIN * 100 / iso) / (WHITE - BLACK)


BRACKETS = {
    "time": [(0.25, 100), (1, 100), (4, 100)],
    "wide": [(1 / 16, 100), (0.5, 100), (1, 100), (6, 100), (16, 100)],
    "iso": [(1, 100), (1, 400), (1, 1600)],
    "repeats": [(1, 100), (1, 100), (1, 100), (1, 100)],
    "single": [(1, 100)],
}


def bracket(quads, settings, seed=0, jitter=0.015, **exif):
    """Frames of (exposure, ISO) pairs with flash jitter, and the exposures that really were."""
    rng = np.random.default_rng(seed)
    exposures = [e * (1 + jitter * rng.normal()) for e, _ in settings]
    isos = [float(iso) for _, iso in settings]
    frames = [frame(expose(quads, e, rng, i), iso=i, flash_fired=True, **exif) for e, i in zip(exposures, isos)]
    return frames, np.array(exposures), np.array(isos)


def reference_of(stack):
    """Index of the frame whose ratio is 1 by definition."""
    return int(np.flatnonzero(np.all(stack.exposure_ratio[0] == 1, axis=1))[0])


@pytest.mark.parametrize("name", BRACKETS)
def test_no_bias_from_20_electrons_up_and_honest_variance(name):
    """Bias < 0.3 % in each octave from 20 e⁻ up; z of mean 0 ± 0.05 and variance 1 ± 0.1; ratios to 0.1 %.

    Gain and read noise are not told: the merge finds them in the frames.
    """
    quads = ramp(768, 1024)
    frames, exposures, isos = bracket(quads, BRACKETS[name], seed=len(name))
    stack = hdr.merge(capture(frames), hdr.Settings())
    r = reference_of(stack)
    light = quads * exposures[r]
    truth = electrons_to_signal(light, isos[r])
    ratios = (exposures * isos) / (exposures[r] * isos[r])
    np.testing.assert_allclose(stack.exposure_ratio[0], np.repeat(ratios[:, None], 3, 1), rtol=1e-3)
    z = scores(stack, truth)
    assert abs(z.mean()) < 0.05
    assert abs(z.var() - 1) < 0.1
    clear = (stack.quality[0] & Quality.CLIPPED) == 0
    low = 20.0
    while low < 2e4:
        octave = clear[..., None] & (light >= low) & (light < 2 * low)
        bias = stack.value[0][octave].sum(dtype=np.float64) / truth[octave].sum() - 1
        assert abs(bias) < 0.003, (low, bias)
        low *= 2
    assert stack.ghost_fraction[0] == 0
    assert stack.value.dtype == stack.variance.dtype == np.float32


def test_negative_values_are_kept():
    dark = np.zeros((64, 64, 3))
    stack = hdr.merge(capture([frame(expose(dark, 1, np.random.default_rng(1)))]), hdr.Settings())
    assert (stack.value < 0).mean() > 0.3
    assert abs(stack.value.mean()) < 4 * np.sqrt(stack.variance.mean() / stack.value.size)
    assert (stack.quality & Quality.DARK).astype(bool).mean() > 0.9


def test_darkest_frame_serves_where_the_others_clip():
    """Only pixels that clip in the darkest frame, or touch one that does, are flagged; all stay finite."""
    quads = ramp(256, 512, high=4e5, ripple=0)
    frames, exposures, _ = bracket(quads, BRACKETS["time"])
    stack = hdr.merge(capture(frames), hdr.Settings())
    full = 0.98 * WHITE - BLACK  # counts
    expected = quads.max(axis=2) * exposures[0] / GAIN
    clipped = (stack.quality[0] & Quality.CLIPPED) > 0
    assert clipped[expected > 1.05 * full].all()
    assert not clipped[expected < 0.9 * full].any()
    assert np.isfinite(stack.value).all() and np.isfinite(stack.variance).all()
    assert (stack.variance > 0).all()
    bright = (expected < 0.9 * full) & (expected > 0.4 * full)  # both others clip
    truth = electrons_to_signal(quads * exposures[1])[bright]
    assert abs(stack.value[0][bright].sum() / truth.sum() - 1) < 1e-3
    assert stack.value[0][clipped].max() > 3.5  # a clipped pixel is as bright as the darkest frame can say


def test_no_seam_where_a_frame_drops_out():
    """Along a ramp through two clipping limits the mean of columns follows the truth to its noise."""
    quads = ramp(512, 1024, ripple=0)
    frames, exposures, _ = bracket(quads, BRACKETS["time"])
    stack = hdr.merge(capture(frames), hdr.Settings())
    truth = electrons_to_signal(quads * exposures[1])
    clear = ((stack.quality[0] & Quality.CLIPPED) == 0).all(axis=0)
    z = ((stack.value[0] - truth).sum(axis=0) / np.sqrt(stack.variance[0].sum(axis=0)))[clear]
    assert np.abs(z).max() < 5.5  # 1500 columns and channels; ratios are known to 0.01 %


def test_full_size_keeps_bias_and_variance_honest():
    y, x = np.mgrid[:512, :640]
    light = (400 * np.exp(x / 160) * (1 + 0.1 * np.sin(y / 40)))[..., None] * np.array([0.6, 1.0, 0.7])
    rng = np.random.default_rng(5)
    mosaic = np.take_along_axis(light, np.tile(RGGB, (256, 320))[..., None].astype(int), 2)[..., 0]

    def shoot(exposure):
        counts = (rng.poisson(mosaic * exposure) + rng.normal(0, READ, mosaic.shape)) / GAIN + BLACK
        return SensorImage(np.clip(np.round(counts), 0, WHITE).astype(np.uint16), np.full((2, 2), BLACK), WHITE, RGGB)

    frames = [frame(shoot(e), iso=100.0) for e in (0.25, 1, 4)]
    stack = hdr.merge(capture(frames), hdr.Settings(demosaic="full"))
    assert stack.value.shape == (1, 512, 640, 3)
    assert (stack.view.scale, stack.view.focal, stack.view.center) == (1, 1000, (100.5, 80.5))
    inner = np.s_[4:-4, 4:-4]
    z = ((stack.value[0] - electrons_to_signal(light)) / np.sqrt(stack.variance[0]))[inner]
    clear = (stack.quality[0][inner] & Quality.CLIPPED) == 0
    assert abs(z[clear].mean()) < 0.05
    assert abs(z[clear].var() - 1) < 0.1


def test_view_is_that_of_the_binned_grid():
    frames, _, _ = bracket(ramp(192, 288), [(1, 100)])
    view = hdr.merge(capture(frames), hdr.Settings()).view
    assert (view.scale, view.focal, view.center) == (2, 500, (50.0, 40.0))


def test_flash_makes_the_shutter_time_a_lie():
    """EXIF promises 1 : 4 : 16; the pops were equal; the frames are averaged as the repeats they are."""
    quads = ramp(256, 384, high=2e4)
    rng = np.random.default_rng(2)
    frames = [frame(expose(quads, 1, rng), iso=100.0, exposure_time=t, flash_fired=True) for t in (0.001, 0.004, 0.016)]
    stack = hdr.merge(capture(frames), hdr.Settings())
    one = hdr.merge(capture(frames[:1]), hdr.Settings())
    np.testing.assert_allclose(stack.exposure_ratio, 1, rtol=2e-3)
    r = reference_of(stack)
    np.testing.assert_allclose(stack.exif_ratio[0], np.array([1, 4, 16]) / 4.0**r)
    assert np.median(stack.variance / one.variance) == pytest.approx(1 / 3, rel=0.05)


def test_metadata_serve_only_where_pixels_cannot_tell_and_no_flash_fired():
    dark = np.full((64, 64, 3), 1.0)

    def frames(**exif):
        rng = np.random.default_rng(0)
        return [frame(expose(dark, e, rng), iso=100.0, exposure_time=e, **exif) for e in (1, 4)]

    stack = hdr.merge(capture(frames(flash_fired=False)), hdr.Settings())
    assert sorted(stack.exposure_ratio[0, :, 0] / stack.exposure_ratio[0, :, 0].min()) == [1, 4]
    with pytest.raises(CaptureError, match="flash fired"):
        hdr.merge(capture(frames(flash_fired=True)), hdr.Settings())
    rng = np.random.default_rng(0)
    stated = [frame(expose(dark, e, rng), flash_fired=True, exposure=e) for e in (1.0, 4.0)]
    assert hdr.merge(capture(stated), hdr.Settings()).exposure_ratio.max() in (1, 4)


def test_ambient_light_is_subtracted_with_its_variance():
    """A time bracket under flash: the flash gives every frame the same, the room in proportion to time."""
    quads = ramp(512, 512, high=4e3, ripple=0)
    room = 300 * (1 + 0.5 * np.cos(np.arange(256) / 30))[None, :, None] * np.ones((256, 1, 3))
    rng = np.random.default_rng(3)
    times = (0.01, 0.04, 0.16)
    frames = [
        frame(expose(quads + room * t / 0.04, 1, rng), iso=100.0, exposure_time=t, flash_fired=True) for t in times
    ]
    ambient = [frame(expose(room * t / 0.04, 1, rng), iso=100.0, exposure_time=t, flash_fired=False) for t in times]
    stack = hdr.merge(capture(frames, ambient=ambient), hdr.Settings())
    np.testing.assert_allclose(stack.exposure_ratio, 1, rtol=3e-3)
    z = scores(stack, electrons_to_signal(quads))
    assert abs(z.mean()) < 0.05
    assert abs(z.var() - 1) < 0.1


def scene(x, y):
    """A band-limited texture at RAW px (x, y), electrons, (..., 3)."""
    detail = (
        np.sin(0.31 * x + 0.11 * y)
        + np.sin(0.12 * x - 0.27 * y + 1)
        + np.sin(0.05 * x * (1 + y / 900)) * np.cos(0.07 * y)
    )
    return (700 * np.exp(0.35 * detail + x / 700))[..., None] * np.array([0.6, 1.0, 0.7])


def photograph(exposure, rng, matrix=None, size=(640, 800)):
    """The scene seen after RAW px (x, y) of the reference moved to matrix @ (x, y, 1)."""
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    if matrix is not None:
        p = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(matrix).T
        x, y = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]
    light = np.take_along_axis(scene(x, y), np.tile(RGGB, (size[0] // 2, size[1] // 2))[..., None].astype(int), 2)[
        ..., 0
    ]
    counts = (rng.poisson(light * exposure) + rng.normal(0, READ, light.shape)) / GAIN + BLACK
    return SensorImage(np.clip(np.round(counts), 0, WHITE).astype(np.uint16), np.full((2, 2), BLACK), WHITE, RGGB)


def turned(dx, dy, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    middle = np.array([[1, 0, 400], [0, 1, 320], [0, 0, 1.0]])
    return middle @ np.array([[c, -s, dx], [s, c, dy], [0, 0, 1]]) @ np.linalg.inv(middle)


@pytest.mark.parametrize("hand", [(5.3, -6.6, 0.2), (0.8, 0.4, 0.0), (-17.0, 12.5, -0.3)])
def test_hand_held_bracket_is_registered(hand):
    """The merge of three moved frames is the reference frame's picture, sharper in noise, and honest."""
    rng = np.random.default_rng(7)
    frames = [
        frame(photograph(0.25, rng, turned(*hand)), iso=100.0),
        frame(photograph(1, rng), iso=100.0),
        frame(photograph(4, rng, turned(-hand[1], hand[0], hand[2] / 2)), iso=100.0),
    ]
    stack = hdr.merge(capture(frames), hdr.Settings())
    still = hdr.merge(capture([frames[1]]), hdr.Settings())
    np.testing.assert_allclose(stack.exposure_ratio[0, :, 1], [0.25, 1, 4], rtol=1e-3)
    assert stack.ghost_fraction[0] < 1e-3
    y, x = np.mgrid[:640, :800].astype(float)
    full = scene(x, y)
    truth = np.stack([full[0::2, 0::2, 0], (full[0::2, 1::2, 1] + full[1::2, 0::2, 1]) / 2, full[1::2, 1::2, 2]], -1)
    inner = np.s_[20:-20, 20:-20]
    error = (stack.value[0] - electrons_to_signal(truth))[inner]
    alone = (still.value[0] - electrons_to_signal(truth))[inner]
    assert np.sqrt(np.mean(error**2)) < 0.75 * np.sqrt(np.mean(alone**2))
    z = error / np.sqrt(stack.variance[0][inner])
    assert abs(z.mean()) < 0.1
    assert 0.8 < z.std() < 1.3


def test_tripod_bracket_is_not_resampled():
    """Noise of neighbours stays independent: resampling would correlate it."""
    rng = np.random.default_rng(9)
    frames = [frame(photograph(e, rng), iso=100.0) for e in (0.25, 1, 4)]
    stack = hdr.merge(capture(frames), hdr.Settings())
    y, x = np.mgrid[:640, :800].astype(float)
    full = scene(x, y)
    error = stack.value[0, ..., 0] - electrons_to_signal(full[0::2, 0::2, 0])
    z = error / np.sqrt(stack.variance[0, ..., 0])
    assert abs(np.mean(z[:, 1:] * z[:, :-1])) < 5 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 0.1


def test_too_much_motion_is_refused():
    rng = np.random.default_rng(7)
    frames = [frame(photograph(1, rng), iso=100.0), frame(photograph(2, rng, turned(9, 9, 0)), iso=100.0)]
    with pytest.raises(CaptureError, match=r"frame \d of shot 0° moved by .* hdr.max_motion_px"):
        hdr.merge(capture(frames), hdr.Settings(max_motion_px=4))


def test_ghost_is_flagged_and_taken_from_the_reference_alone():
    """Something bright stands elsewhere in the brightest frame."""
    rng = np.random.default_rng(11)
    quads = np.full((256, 256, 3), 800.0)
    other = quads.copy()
    other[100:140, 60:110] *= 1.5
    frames = [frame(expose(q, e, rng), iso=100.0) for q, e in ((quads, 0.25), (quads, 1), (other, 4))]
    stack = hdr.merge(capture(frames), hdr.Settings())
    ghost = (stack.quality[0] & Quality.GHOST) > 0
    assert ghost[102:138, 62:108].all()
    ghost[94:146, 54:116] = False
    assert not ghost.any()
    z = scores(stack, electrons_to_signal(quads))
    assert abs(z.mean()) < 0.05 and abs(z.var() - 1) < 0.1
    inside = stack.value[0][105:135, 65:105]
    assert inside.mean() == pytest.approx(float(electrons_to_signal(800.0)), rel=5e-3)


def test_monochrome_channel_stands_in_three_with_three_times_the_variance():
    """So that the sum over channels, and its variance, is that of three independent ones."""
    rng = np.random.default_rng(13)
    light = np.repeat(np.exp(np.linspace(5, 9, 400))[None], 300, 0)

    def shoot(exposure):
        gray = np.clip(np.round(rng.poisson(light * exposure) / GAIN + BLACK), 0, WHITE).astype(np.uint16)
        return SensorImage(np.repeat(gray[..., None], 3, 2), np.full((1, 1), BLACK), WHITE, None)

    stack = hdr.merge(capture([frame(shoot(e), iso=100.0) for e in (0.5, 1, 2)]), hdr.Settings())
    assert stack.value.shape == (1, 300, 400, 3)
    assert (stack.view.scale, stack.view.center) == (1, (100.5, 80.5))
    total = stack.value[0].mean(axis=2) - electrons_to_signal(light)
    z = total / np.sqrt(stack.variance[0].sum(axis=2) / 9)
    assert abs(z.mean()) < 0.05
    assert abs(z.var() - 1) < 0.1


def test_three_channel_frames_pass_unbinned_and_lossy_is_told():
    rng = np.random.default_rng(15)
    light = np.exp(np.linspace(5, 9, 300))[None, :, None] * np.ones((200, 1, 3)) * [0.6, 1, 0.7]
    frames = [
        frame(SensorImage(rng.poisson(light * e).astype(np.float32) / 2e4, np.zeros((1, 1)), 1.0, None, lossy=e == 1))
        for e in (0.5, 1, 2)
    ]
    stack = hdr.merge(capture(frames), hdr.Settings())
    assert stack.value.shape == (1, 200, 300, 3) and stack.lossy
    z = scores(stack, light / 2e4)
    assert abs(z.mean()) < 0.05 and abs(z.var() - 1) < 0.1


def test_shots_share_the_reference_index_and_keep_their_own_flash_energy():
    quads = ramp(256, 384, high=2e4)
    one, a, _ = bracket(quads, BRACKETS["time"], seed=1)
    two, b, _ = bracket(quads, BRACKETS["time"], seed=2)
    stack = hdr.merge(capture(one, two), hdr.Settings())
    assert np.all(stack.exposure_ratio[:, 1] == 1)
    clear = ((stack.quality & Quality.CLIPPED) == 0).all(axis=0)
    gain = stack.value[1][clear].sum() / stack.value[0][clear].sum()
    assert gain == pytest.approx(b[1] / a[1], rel=1e-3)


def test_unequal_brackets_and_sizes_are_refused_by_name():
    rng = np.random.default_rng(0)
    small, large = expose(ramp(192, 192), 1, rng), expose(ramp(192, 256), 1, rng)
    with pytest.raises(CaptureError, match=r"shot 45° has 1 frames, shot 0° has 2"):
        hdr.merge(capture([frame(small)] * 2, [frame(small)]), hdr.Settings())
    with pytest.raises(CaptureError, match=r"^shot 45° is 128×96"):
        hdr.merge(capture([frame(small)], [frame(large)]), hdr.Settings())


def test_a_plateau_below_the_stated_white_is_saturation():
    """Some cameras clip earlier than their metadata say."""
    quads = np.full((64, 64, 3), 5000.0)
    quads[:, 32:] = 1e5
    image = expose(quads, 1, np.random.default_rng(0))
    early = SensorImage(np.minimum(image.value, np.uint16(12000)), image.black, WHITE, RGGB)
    stack = hdr.merge(capture([frame(early)]), hdr.Settings())
    clipped = (stack.quality[0] & Quality.CLIPPED) > 0
    assert clipped[:, 32:].all() and not clipped[:, :31].any()


def test_little_memory_gives_the_same_pixels_and_less_is_refused_by_its_least(monkeypatch):
    quads = ramp(256, 256, high=2e4)
    shots = [[frame(expose(quads, e, np.random.default_rng(k)), exposure=e) for e in (1, 4)] for k in (0, 1)]
    plenty = hdr.merge(capture(*shots), hdr.Settings())
    needed = 128 * 128 * (2 * 25 + 2 * 9 + 60)
    monkeypatch.setattr(budget, "_memory", lambda: (0, needed))
    little = hdr.merge(capture(*shots), hdr.Settings())
    for name in ("value", "variance", "quality", "exposure_ratio"):
        np.testing.assert_array_equal(getattr(little, name), getattr(plenty, name))
    monkeypatch.setattr(budget, "_memory", lambda: (1_000_000_000, needed + 999_999_999))
    with pytest.raises(SettingError, match=r"needs 1\.00 GB at least"):
        hdr.merge(capture(*shots), hdr.Settings())


def test_frames_stream(monkeypatch):
    """With room for three decoded frames, never more than these and the next are alive, of nine."""
    monkeypatch.setattr(budget, "plan", lambda *_: budget.Budget(frames=3 * 2 * 256 * 256))
    quads = ramp(256, 256, high=2e4)
    alive: weakref.WeakSet[Any] = weakref.WeakSet()
    most = 0

    def lazily(exposure, seed):
        def load():
            nonlocal most
            image = expose(quads, exposure, np.random.default_rng(seed))
            array = np.array(image.value)  # weak references need an owner of memory
            holder = SensorImage(array, image.black, image.white, image.cfa)
            alive.add(_Tracked(array))
            most = max(most, sum(1 for t in alive))
            return holder

        return Frame("x", Exif(iso=100.0), "shot", "", load)

    class _Tracked:
        def __init__(self, array):
            weakref.finalize(array, lambda: alive.discard(self))
            self.array_id = id(array)

    hdr.merge(capture([lazily(e, k) for k, e in enumerate(np.geomspace(0.2, 4, 9))]), hdr.Settings())
    assert most <= 4  # one is being decoded


DATA = os.environ.get("POLCAP_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="POLCAP_DATA is not set: no RAW files to merge")


def raw_file(path, **exif):
    """A DNG by rawpy alone, independent of the project's reader."""
    rawpy = pytest.importorskip("rawpy")

    def load():
        with rawpy.imread(str(path)) as raw:
            cfa = np.where(raw.raw_pattern == 3, 1, raw.raw_pattern).astype(np.uint8)
            black = np.array(raw.black_level_per_channel, float)[raw.raw_pattern]
            return SensorImage(raw.raw_image_visible.copy(), black, float(raw.white_level), cfa)

    return Frame(str(path), Exif(**exif), "shot", "", load)


@needs_data
@pytest.mark.parametrize("name", ["d21_spot", "d22_demosthenes", "d23_penguin", "d24_scorpion"])
def test_rendered_captures_give_their_exposure_ratios(name):
    """Time, aperture and ISO brackets with flash jitter of 1.5 %: every ratio to 0.1 %, nothing moved."""
    folder = Path(DATA) / "rendered"
    shots = json.loads((folder / f"{name}.truth.json").read_text())["shots"]
    frames = [raw_file(folder / s["file"], iso=float(s["iso"]), flash_fired=True) for s in shots]
    stack = hdr.merge(capture(frames[:3], frames[3:6], frames[6:]), hdr.Settings())
    exposure = np.array([s["relative_exposure"] * s["flash_factor"] for s in shots]).reshape(3, 3)
    expected = np.repeat((exposure / exposure[:, 1:2])[..., None], 3, axis=2)
    np.testing.assert_allclose(stack.exposure_ratio, expected, rtol=1e-3)
    assert np.all(stack.ghost_fraction == 0)
    assert not (stack.quality & Quality.CLIPPED).any()


@needs_data
def test_hand_held_nikon_bracket():
    """4–7 px misaligned, sky clipped in the long frame, people walking and a car in the foreground.

    The pixels' median quotient without registration is 3.96 and 4.14. That choice of unclipped pixels favours
    what is dark in the long frame: sums of 32 px blocks chosen by the middle frame alone, which motion of a few
    pixels cannot touch, give 3.96 and 4.21–4.23 (LibRaw's counts and NumPy, none of this code).
    """
    folder = Path(DATA) / "real" / "raw_bracket"
    times = {"sample2.dng": 1 / 640, "sample1.dng": 1 / 160, "sample3.dng": 1 / 40}
    frames = [raw_file(folder / n, iso=200.0, exposure_time=t, f_number=6.3) for n, t in times.items()]
    stack = hdr.merge(capture(frames), hdr.Settings())
    ratio = stack.exposure_ratio[0].mean(axis=1)
    assert ratio[1] / ratio[0] == pytest.approx(3.96, rel=0.01)
    assert ratio[2] / ratio[1] == pytest.approx(4.21, rel=0.01)
    np.testing.assert_allclose(stack.exif_ratio, [[0.25, 1, 4]])
    # what moved is flagged, and hardly anything else: the building above the street has no ghosts
    ghost = (stack.quality[0] & Quality.GHOST) > 0
    assert 0.005 < ghost.mean() < 0.03
    assert ghost[:1150].mean() < 0.001
    # frame against frame, registered and on one scale, where nothing moved
    shot = Shot(0.0, tuple(frames))
    found = links.measure(shot, [0, 1, 2], 1, noise.Lines(), Reader(()), 0.98, 60.0)
    own, first = signals(frames[1].load(), 0.98).rows(slice(None)), found.estimate
    assert found.frames is not None
    for e in (0, 2):
        link, (other, gain) = found.links[e], (found.frames[e].signals, found.frames[e].gain)
        assert link.moved is not None
        usable = other.usable & found.frames[1].signals.usable & ~ghost
        z = []
        for c, ratio in enumerate(link.ratio):
            variance = found.noises[1].of(c, first[c])
            variance += found.noises[e].of(c, first[c] * ratio) / ratio**2 * gain
            variance += bracket_pixels.edges(first[c]) * link.misfit[c]
            z.append(((other.rows(slice(None))[c] / ratio - own[c]) / np.sqrt(variance))[usable])
        assert np.all(np.abs(np.mean(z, axis=1)) < 0.1)
        assert np.all(np.abs(MAD_TO_SIGMA * np.median(np.abs(z), axis=1) - 1.05) < 0.25)
        assert 0.8 < np.std(z) < 1.3


def test_x_trans_brackets_give_the_light_of_a_bayer_camera(tmp_path):
    """The same scene through both mosaics: S0 of each channel alike within noise, three RAW px per px."""
    shoot = shooting.Shoot(seed=3, width=312, height=234, nudge_px=0.0, nudge_deg=0.0, gain_jitter=0.0, samples=1)
    merged = {}
    for cfa in ("RGGB", "X-Trans"):
        shooting.write(tmp_path / cfa, shooting.random_scene(3, "bumps"), structs.replace(shoot, cfa=cfa))
        capture = captures.read(tmp_path / cfa)
        merged[cfa] = hdr.merge(capture, hdr.Settings())
        if cfa == "X-Trans":
            with pytest.raises(CaptureError, match="X-Trans"):
                hdr.merge(capture, hdr.Settings(demosaic="full"))
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
