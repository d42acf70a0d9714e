"""The merge is unbiased down to the dark, knows its own variance, and says where it cannot know."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.image_values import Quality, SensorImage
from tests.stages.hdr.brackets import (
    BLACK,
    BRACKETS,
    DATA,
    GAIN,
    RGGB,
    WHITE,
    bracket,
    capture,
    check_errors,
    electrons_to_signal,
    expose,
    frame,
    merge,
    needs_data,
    ramp,
    raw_file,
    reference_of,
)


@pytest.mark.parametrize("name", BRACKETS)
def test_no_bias_from_20_electrons_up_and_honest_variance(name):
    """Bias < 0.3 % in each octave from 20 e⁻ up; z of mean 0 ± 0.05 and variance 1 ± 0.1; ratios to 0.1 %.

    Gain and read noise are not stated: the merge finds them in the frames.
    """
    quads = ramp(768, 1024)
    frames, exposures, isos = bracket(quads, BRACKETS[name], seed=len(name))
    stack = merge(capture(frames))
    r = reference_of(stack)
    light = quads * exposures[r]
    truth = electrons_to_signal(light, isos[r])
    ratios = (exposures * isos) / (exposures[r] * isos[r])
    np.testing.assert_allclose(stack.bracket.exposure_ratio[0], np.repeat(ratios[:, None], 3, 1), rtol=1e-3)
    check_errors(stack, truth)
    clear = (stack.quality[0] & Quality.CLIPPED) == 0
    low = 20.0
    while low < 2e4:
        octave = clear[..., None] & (light >= low) & (light < 2 * low)
        bias = stack.value[0][octave].sum(dtype=np.float64) / truth[octave].sum() - 1
        assert abs(bias) < 0.003, (low, bias)
        low *= 2
    assert stack.bracket.ghost_fraction[0] == 0
    assert stack.value.dtype == stack.variance.dtype == np.float32


def test_negative_values_stay_negative():
    dark = np.zeros((64, 64, 3))
    stack = merge(capture([frame(expose(dark, 1, np.random.default_rng(1)))]))
    assert (stack.value < 0).mean() > 0.3
    assert abs(stack.value.mean()) < 4 * np.sqrt(stack.variance.mean() / stack.value.size)
    assert (stack.quality & Quality.DARK).astype(bool).mean() > 0.9


def test_darkest_frame_serves_where_the_others_clip():
    """Only pixels that clip in the darkest frame, or touch one that does, are flagged; all stay finite."""
    quads = ramp(256, 512, high=4e5, ripple=0)
    frames, exposures, _ = bracket(quads, BRACKETS["time"])
    stack = merge(capture(frames))
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
    stack = merge(capture(frames))
    truth = electrons_to_signal(quads * exposures[1])
    clear = ((stack.quality[0] & Quality.CLIPPED) == 0).all(axis=0)
    z = ((stack.value[0] - truth).sum(axis=0) / np.sqrt(stack.variance[0].sum(axis=0)))[clear]
    assert np.abs(z).max() < 5.5  # 1500 columns and channels; ratios are known to 0.01 %


@pytest.mark.parametrize("room", [0.0, 0.05])
def test_variance_has_no_step_where_a_frame_drops_out(room):
    """The weight of a frame falls before it clips, also below the stated white level, and with ambient light."""
    full = 0.8 * WHITE  # counts at which the sensor saturates
    light = np.broadcast_to(np.linspace(0.4, 1.1, 1024), (512, 1024)) / 4  # of full

    def early(value, exposure):
        counts = np.clip(np.round(BLACK + (full - BLACK) * value), 0, full).astype(np.uint16)
        return frame(SensorImage(counts, np.full((2, 2), BLACK), WHITE, RGGB), iso=100.0, exposure=exposure)

    ambient = [early(np.full_like(light, room), 1)] if room else []
    frames = [early(e * (light + room), e) for e in (1, 4)]
    stack = merge(capture(frames, ambient=ambient))
    sigma2 = stack.variance[0][128, :, 1]
    assert sigma2[-1] > 3 * sigma2[0]
    assert np.abs(np.diff(np.log(sigma2))).max() < 0.5


def test_flash_makes_the_shutter_time_a_lie():
    """EXIF promises 1 : 4 : 16; the pops were equal; the frames are averaged as the repeats they are."""
    quads = ramp(256, 384, high=2e4)
    rng = np.random.default_rng(2)
    frames = [frame(expose(quads, 1, rng), iso=100.0, exposure_time=t, flash_fired=True) for t in (0.001, 0.004, 0.016)]
    stack = merge(capture(frames))
    one = merge(capture(frames[:1]))
    np.testing.assert_allclose(stack.bracket.exposure_ratio, 1, rtol=2e-3)
    r = reference_of(stack)
    np.testing.assert_allclose(stack.bracket.exif_ratio[0], np.array([1, 4, 16]) / 4.0**r)
    assert np.median(stack.variance / one.variance) == pytest.approx(1 / 3, rel=0.05)


def test_metadata_serve_only_where_pixels_cannot_tell_and_no_flash_fired():
    dark = np.full((64, 64, 3), 1.0)

    def frames(**exif):
        rng = np.random.default_rng(0)
        return [frame(expose(dark, e, rng), iso=100.0, exposure_time=e, **exif) for e in (1, 4)]

    stack = merge(capture(frames(flash_fired=False)))
    assert sorted(stack.bracket.exposure_ratio[0, :, 0] / stack.bracket.exposure_ratio[0, :, 0].min()) == [1, 4]
    with pytest.raises(CaptureError, match="flash fired"):
        merge(capture(frames(flash_fired=True)))
    rng = np.random.default_rng(0)
    stated = [frame(expose(dark, e, rng), flash_fired=True, exposure=e) for e in (1.0, 4.0)]
    assert merge(capture(stated)).bracket.exposure_ratio.max() in (1, 4)


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
    stack = merge(capture(frames, ambient=ambient))
    np.testing.assert_allclose(stack.bracket.exposure_ratio, 1, rtol=3e-3)
    check_errors(stack, electrons_to_signal(quads))


def test_an_ambient_frame_of_several_angles_is_noted() -> None:
    quads = ramp(256, 256, high=4e3, ripple=0)
    rng = np.random.default_rng(0)
    frames = [frame(expose(quads, 1, rng), iso=100.0, exposure_time=0.01) for _ in range(2)]
    dark = [replace(frame(expose(0.1 * quads, 1, rng), iso=100.0, exposure_time=0.01), digest=name) for name in "ab"]
    for ambient, shared in (((dark[:1], dark[:1]), True), ((dark[:1], dark[1:]), False)):
        both = capture(frames[:1], frames[1:])
        shots = tuple(replace(shot, ambient=tuple(own)) for shot, own in zip(both.shots, ambient))
        assert merge(replace(both, shots=shots)).bracket.ambient_shared == shared


def test_ambient_frames_with_the_flash_on_are_refused() -> None:
    quads, rng = ramp(256, 256, high=4e3, ripple=0), np.random.default_rng(0)
    lit = [frame(expose(quads, 1, rng), iso=100.0, exposure_time=0.01) for _ in range(2)]
    with pytest.raises(CaptureError, match="without the flash"):
        merge(capture(lit[:1], ambient=lit[1:]))


def test_ghost_is_flagged_and_taken_from_the_reference_alone():
    """In the brightest frame, something bright is at another place."""
    rng = np.random.default_rng(11)
    quads = np.full((256, 256, 3), 800.0)
    other = quads.copy()
    other[100:140, 60:110] *= 1.5
    frames = [frame(expose(q, e, rng), iso=100.0) for q, e in ((quads, 0.25), (quads, 1), (other, 4))]
    stack = merge(capture(frames))
    ghost = (stack.quality[0] & Quality.GHOST) > 0
    assert ghost[102:138, 62:108].all()
    ghost[94:146, 54:116] = False
    assert not ghost.any()
    check_errors(stack, electrons_to_signal(quads))
    inside = stack.value[0][105:135, 65:105]
    assert inside.mean() == pytest.approx(float(electrons_to_signal(800.0)), rel=5e-3)


def test_shots_share_the_reference_index_and_keep_their_own_flash_energy():
    quads = ramp(256, 384, high=2e4)
    one, a, _ = bracket(quads, BRACKETS["time"], seed=1)
    two, b, _ = bracket(quads, BRACKETS["time"], seed=2)
    stack = merge(capture(one, two))
    assert np.all(stack.bracket.exposure_ratio[:, 1] == 1)
    clear = ((stack.quality & Quality.CLIPPED) == 0).all(axis=0)
    gain = stack.value[1][clear].sum() / stack.value[0][clear].sum()
    assert gain == pytest.approx(b[1] / a[1], rel=1e-3)


def test_unequal_sizes_are_refused_by_name():
    rng = np.random.default_rng(0)
    small, large = expose(ramp(192, 192), 1, rng), expose(ramp(192, 256), 1, rng)
    with pytest.raises(CaptureError, match=r"^shot 45° is 128×96"):
        merge(capture([frame(small)], [frame(large)]))


def test_a_plateau_below_the_stated_white_is_saturation():
    """Some cameras clip earlier than their metadata say."""
    quads = np.full((64, 64, 3), 5000.0)
    quads[:, 32:] = 1e5
    image = expose(quads, 1, np.random.default_rng(0))
    early = SensorImage(np.minimum(image.value, np.uint16(12000)), image.black, WHITE, RGGB)
    stack = merge(capture([frame(early)]))
    clipped = (stack.quality[0] & Quality.CLIPPED) > 0
    assert clipped[:, 32:].all() and not clipped[:, :31].any()


@needs_data
@pytest.mark.parametrize("name", ["d21_spot", "d22_demosthenes", "d23_penguin", "d24_scorpion"])
def test_rendered_captures_give_their_exposure_ratios(name):
    """Time, aperture and ISO brackets with flash jitter of 1.5 %: every ratio to 0.1 %, nothing moved."""
    folder = Path(DATA) / "rendered"
    shots = json.loads((folder / f"{name}.truth.json").read_text())["shots"]
    frames = [raw_file(folder / s["file"], iso=float(s["iso"]), flash_fired=True) for s in shots]
    stack = merge(capture(frames[:3], frames[3:6], frames[6:]))
    exposure = np.array([s["relative_exposure"] * s["flash_factor"] for s in shots]).reshape(3, 3)
    expected = np.repeat((exposure / exposure[:, 1:2])[..., None], 3, axis=2)
    np.testing.assert_allclose(stack.bracket.exposure_ratio, expected, rtol=1e-3)
    assert np.all(stack.bracket.ghost_fraction == 0)
    assert not (stack.quality & Quality.CLIPPED).any()


def with_black(frame, error):
    """A frame that states a black level `error` counts above the true one."""
    image = frame.load()
    return replace(frame, load=lambda: replace(image, black=image.black + error))


@pytest.mark.parametrize("error", [-40.0, 4.0, 40.0])
def test_a_wrong_black_level_leaves_no_trace(error):
    """Merged as with the true level: no ghosts, and values within 1e-5 of the range and .1 %."""
    frames, *_ = bracket(ramp(192, 256), BRACKETS["time"], seed=3)
    timed = [replace(one, exif=replace(one.exif, exposure_time=time)) for one, time in zip(frames, (0.01, 0.04, 0.16))]
    right = merge(capture(timed))
    wrong = merge(capture([with_black(one, error) for one in timed]))
    assert wrong.bracket.black.corrected and not right.bracket.black.error.any()
    np.testing.assert_allclose(wrong.bracket.black.error, -error / (WHITE - BLACK), rtol=0.1, atol=2e-5)
    assert wrong.bracket.ghost_fraction[0] == right.bracket.ghost_fraction[0] == 0
    clear = (right.quality[0] & Quality.CLIPPED) == 0
    np.testing.assert_allclose(wrong.value[0][clear], right.value[0][clear], rtol=5e-3, atol=2e-5)


def test_a_room_s_light_is_not_taken_for_black():
    """Under a flash of varied power, the room adds the same light to all frames."""
    quads = ramp(384, 512, ripple=0)
    rng = np.random.default_rng(4)
    room = 100.0  # e⁻, .3 % of the range
    frames = [
        frame(expose(quads + room / e, e, rng), iso=100.0, exposure_time=0.01, flash_fired=True) for e in (0.25, 1, 4)
    ]
    stack = merge(capture(frames))
    assert stack.bracket.black.error.min() > 0.002 and not stack.bracket.black.corrected
