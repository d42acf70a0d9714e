"""Each gate speaks of its own fault, in words, beyond its own error; nothing speaks on a good capture."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from polcap.capture_values import ShotOrder
from polcap.chart_values import ChartPlace
from polcap.config import Config
from polcap.image_values import Quality
from polcap.optics import frames
from polcap.quality import flatness, gates, geometry, object_turn
from polcap.quality.advice import advice, advise
from polcap.quality.gate_values import Evidence, Gate, State
from polcap.results import ResultsUntilInfer
from polcap.stage_values import (
    AngleStack,
    BlackError,
    ColorSensor,
    Equipment,
    OutlineCheck,
    RingZero,
    SurfaceMaps,
    TurnedShot,
)
from polcap.stages import cues, selfcal, stokes
from polcap.stages.align import object_motion
from tests import scenes

Seen = Evidence[ResultsUntilInfer]
STEPS = np.tile([[[0.25], [1.0], [4.0]]], (3, 1, 3))  # (K, E, 3) exposure ratios of three brackets of three frames
FILES = tuple(tuple(f"pol{k}/{e}.DNG" for e in range(3)) for k in range(3))  # of these brackets
STOPPED = ("object_", "selfcal", "stokes", "cues", "maps")  # results after an error of the registration


def found(angles: np.ndarray = scenes.ANGLES, **changed: Any) -> Seen:
    """A ball well photographed, or with something of it changed."""
    radiance = changed.pop("radiance", scenes.stack(noise=0.002, angles=angles))
    shots = len(radiance.angle)
    object_ = scenes.ball_object()
    unchecked = selfcal.SelfcalSettings(check_order=False)
    solved = selfcal.solve(radiance, scenes.still(shots), object_, scenes.no_color(), unchecked)
    gains = replace(solved.gains, source="grey patches", sigma=0 * solved.gains.sigma, disagreement=0.0)
    calibration = changed.pop("selfcal", replace(solved, gains=gains))
    image = stokes.solve(radiance, scenes.still(shots), calibration, object_, stokes.StokesSettings())
    normal = scenes.truth()[0].astype(np.float32)
    flat = np.full(image.mask.shape, 0.5, np.float32)
    grey = np.repeat(flat[..., None], 3, axis=2)
    maps = SurfaceMaps(normal, grey, grey, flat, None, 8 * flat, image.mask, image.view, "analytic", 0.1)
    given = {
        "names": [f"{np.degrees(a):g}°" for a in radiance.angle], "focal_doubt": (0.0, 0.0), "grid_px": 1.0,
        "chart_missing": "", "clipped": clipped(), "blur_px": radiance.bracket.blur_px, "radiance": radiance,
        "color": scenes.no_color(), "alignment": scenes.still(shots), "object_": object_, "selfcal": calibration,
        "stokes": image, "maps": maps, "cues": cues.compute(image, scenes.no_color()),
    }  # fmt: skip
    return scenes.evidence(**{**given, **changed})


def clipped(second_shot: float = 0.0) -> np.ndarray:
    """(K, E, H, W): the share of each pixel of the ball that is clipped in three shots of one exposure."""
    share = np.zeros((3, 1, *scenes.ball_object().mask.shape))
    share[1] = second_shot
    return share


@pytest.fixture(scope="module", autouse=True)
def measured_once() -> Iterator[None]:
    """The object's motion is measured once in the same pictures: that takes most of the time of the gates."""

    def cached(measure: Callable[..., Any]) -> Callable[..., Any]:
        results: dict[tuple[int, ...], tuple[Any, ...]] = {}  # with their inputs, so that these stay

        def call(stack: AngleStack, *others: Any) -> Any:
            parts = (stack.value, stack.variance, stack.quality, stack.angle, stack.offset_px, *others)
            key = tuple(map(id, parts))
            if key not in results:
                results[key] = (*parts, measure(stack, *others))
            return results[key][-1]

        return call

    with pytest.MonkeyPatch.context() as patch:
        for module in (object_motion, object_turn):
            patch.setattr(module, "measure", cached(module.measure))
        yield


@pytest.fixture(scope="module")
def good() -> Seen:
    return found()


def judged(of: Seen) -> dict[str, Gate]:
    return {gate.name: gate for gate in gates.judge(of, Config().gates)}


def failed(of: Seen) -> list[str]:
    return [name for name, gate in judged(of).items() if gate.state == "fail"]


def test_nothing_fails_on_a_good_capture(good: Seen) -> None:
    assert failed(good) == []
    assert gates.verdict(judged(good).values()) == "warn"  # one exposure per shot


def changed(good: Seen, **fields: Any) -> Seen:
    """The evidence with some results or measurements replaced."""
    return scenes.evidence(**{**parts(good), **fields})


def parts(good: Seen) -> dict[str, Any]:
    """All results and measurements, by their names."""
    return {
        name: value
        for name, value in (vars(good) | vars(good.results)).items()
        if name not in ("results", "keys", "rerendered")
    }


def bracket(radiance: AngleStack, **measured: Any) -> AngleStack:
    """A stack of shots whose brackets measured something else."""
    return replace(radiance, bracket=replace(radiance.bracket, **measured))


def with_gains(good: Seen, **fields: Any) -> dict[str, Any]:
    return {"selfcal": replace(good.results.selfcal, gains=replace(good.results.selfcal.gains, **fields))}


def noisy(good: Seen, dolp: float) -> dict[str, Any]:
    """Uncertain normals, and noise that adds this polarization."""
    light = good.results.stokes.stokes[0].sum(-1, keepdims=True)
    covariance = np.broadcast_to((dolp * light) ** 2 / 3, good.results.stokes.covariance.shape)
    maps = replace(good.results.maps, confidence=np.full_like(good.results.maps.confidence, 25.0))
    return {"maps": maps, "stokes": replace(good.results.stokes, covariance=covariance)}


def test_each_gate_fails_alone(good: Seen) -> None:
    radiance = good.results.radiance
    still = good.results.alignment
    away = still.transform.copy()
    away[1, 0, 2] = 50
    curved = np.array([[0.0, -0.2]] * 3)
    ratios = np.tile([[[1.0], [4.0]]], (3, 1, 3))
    pairs: dict[str, Any] = {"exposure_ratio": ratios, "exif_ratio": np.array([[1.0, 4.0]] * 3)}
    faults: dict[str, dict[str, Any]] = {
        "tone curve": {"radiance": bracket(radiance, curvature=curved, **pairs)},
        "flicker": {"radiance": bracket(radiance, flicker=np.array([[np.nan, 0.05]] * 3), **pairs)},
        "stillness": {"radiance": replace(radiance, quality=np.full_like(radiance.quality, Quality.GHOST))},
        "ambient": {"radiance": bracket(radiance, ambient_share=np.array([0.4, 0.4, 0.4]))},
        "alignment": {"alignment": replace(still, transform=away)},
        "clipping": {"clipped": clipped(0.03)},
        "sharpness": {"blur_px": np.array([[0.0], [2.0], [0.1]])},
        "gains": with_gains(good, gain=np.array([[1.0] * 3, [1.0] * 3, [1.3] * 3])),
        "gain doubt": with_gains(good, disagreement=0.05),
        "mask": {"object_": replace(good.results.object_, doubt=0.3)},  # by its network
        "normal error": noisy(good, 0.03),
    }
    for name, fields in faults.items():
        found = judged(changed(good, **fields))
        assert found[name].state == "fail" and found[name].remedy, name
        assert [other for other in found if found[other].state == "fail"] in ([name], [name, "normal error"]), name


@pytest.mark.parametrize(
    ("shots", "measured", "levels"),
    [
        ((0, 1, 2), {}, True),
        ((1,), {}, False),
        ((1,), {"curvature": np.array([[0.0, 0.0], [0.0, -0.3], [0.0, 0.0]])}, True),
        ((1,), {"black": BlackError(np.full(3, 0.004))}, True),
        ((1,), {"black": BlackError(np.full(3, 0.004), True)}, False),
    ],
)
def test_an_object_that_differs_as_a_whole_has_wrong_levels(
    good: Seen, shots: tuple[int, ...], measured: dict[str, Any], levels: bool
) -> None:
    quality = good.results.radiance.quality.copy()
    quality[list(shots)] |= int(Quality.GHOST)
    radiance = bracket(replace(good.results.radiance, quality=quality), **measured)
    gate = judged(changed(good, radiance=radiance))["stillness"]
    assert gate.state == "fail"
    assert ("moved" in gate.remedy, "black level" in gate.message, bool(gate.shots)) == (not levels, levels, not levels)


def test_wrong_levels_of_finished_pictures_are_stated_in_capture_toml(good: Seen) -> None:
    quality = np.full_like(good.results.radiance.quality, Quality.GHOST)
    for sensor, remedy in ((ColorSensor(), "capture.toml"), (ColorSensor(white_balance=np.ones(3)), "own RAW files")):
        radiance = replace(good.results.radiance, quality=quality, sensor=sensor)
        assert remedy in judged(changed(good, radiance=radiance))["stillness"].remedy


@pytest.mark.parametrize(("grid_px", "state"), [(1.0, "warn"), (2.0, "fail")])
def test_a_push_counts_in_pixels_of_the_processed_picture(good: Seen, grid_px: float, state: str) -> None:
    """One pixel is under the limit of 1.5; on pictures averaged down to half the side it is two, and above it."""
    pushed = np.array([[1.0, 0, 1], [0, 1, 0], [0, 0, 1]])
    radiance = scenes.before_backdrop([np.eye(3), pushed, np.eye(3)])
    gate = judged(changed(good, radiance=radiance, grid_px=grid_px))["alignment"]
    assert gate.state == state and gate.shots == ("45°",)


@pytest.mark.parametrize(
    ("cause", "silent", "judged_still"),
    [
        ("order", {"angles", "body", "room light", "outline"}, {"gains", "ambient", "normal error"}),
        ("clipping", {"alignment", "stillness", "gains", "order", "angles", "lighting"}, {"ambient", "focal length"}),
        ("alignment", {"stillness", "gains", "order", "body", "lighting", "ill-posed"}, {"noise", "chart"}),
        ("sharpness", {"alignment", "stillness", "order"}, {"noise", "chart"}),
    ],
)
def test_what_a_failed_gate_explains_is_not_judged(
    good: Seen, cause: str, silent: set[str], judged_still: set[str]
) -> None:
    unlike = replace(good.results.alignment, correlation=np.array([1.0, 0.9, 0.1]))
    quality = np.full_like(good.results.radiance.quality, Quality.GHOST)  # one of the consequences
    faults: dict[str, dict[str, Any]] = {
        "order": {"selfcal": replace(good.results.selfcal, outline=OutlineCheck(ShotOrder((2, 1, 0)), 0.9))},
        "clipping": {"clipped": clipped(0.3), "alignment": unlike},
        "alignment": {"alignment": unlike, "radiance": replace(good.results.radiance, quality=quality)},
        "sharpness": {
            "blur_px": np.array([[0.0], [3.0], [0.0]]),
            "alignment": replace(good.results.alignment, residual_px=np.array([0.0, 1.0, 0.0])),
        },
    }
    found = judged(changed(good, **faults[cause]))
    assert found[cause].state == "fail"
    for name in silent:
        assert found[name].state == "not judged" and cause in found[name].message and not found[name].cost_deg, name
    assert all(found[name].state != "not judged" for name in judged_still if name in found)
    assert ("normal error" in found) is (cause != "order")


def test_sharpness_is_not_compared_between_two_objects(good: Seen) -> None:
    unlike = replace(good.results.alignment, correlation=np.array([1.0, 0.3, 0.9]))
    found = judged(changed(good, blur_px=np.array([[0.0], [3.0], [0.0]]), alignment=unlike))
    assert (found["sharpness"].state, found["alignment"].state) == ("not measured", "fail")
    assert "files" in found["alignment"].remedy


def test_a_frame_without_light_is_named(good: Seen) -> None:
    unlit = STEPS.copy()
    unlit[2, 2] = 1e-4
    radiance = bracket(good.results.radiance, exposure_ratio=unlit, exif_ratio=STEPS[..., 0])
    radiance = replace(radiance, equipment=Equipment("steady"))
    found = changed(good, radiance=radiance, files=FILES, blur_px=np.zeros((3, 3)))
    assert judged(found)["energy"].remedy.startswith("Move pol0/2.DNG, pol1/2.DNG, pol2/2.DNG out of the folder")
    assert advice(list(judged(found).values()))[0].name == "energy"


def test_chart_and_flat_object_need_not_agree_on_the_light(good: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    disagreeing = changed(good, **with_gains(good, source="grey patches", disagreement=0.08))
    assert judged(disagreeing)["gain doubt"].state == "fail"
    edges = flatness.Flatness(
        contour=0.0, common=0.7, rim_dolp=0.2, rim_light=1.0, aligned=0.9, facing=0.8, expected_deg=15.0
    )
    monkeypatch.setattr(flatness, "measure", lambda *_: edges)
    assert judged(disagreeing)["gain doubt"].state == "pass"
    assert judged(disagreeing)["outline"].state == "not judged"


def test_clipped_highlights_show_no_light_from_the_sides(good: Seen) -> None:
    cues = good.results.cues
    ratio, quality = cues.ratio.copy(), cues.quality.copy()
    light = cues.radiance.sum(-1)
    brightest = cues.mask & (light >= np.quantile(light[cues.mask], 0.9))
    ratio[0][brightest] = 0.3
    polarized = replace(cues, ratio=ratio)
    assert judged(changed(good, cues=polarized))["lighting"].state in ("warn", "fail")
    quality[brightest] |= np.uint8(Quality.CLIPPED)
    assert judged(changed(good, cues=replace(polarized, quality=quality)))["lighting"].state == "pass"


def test_a_blurred_frame_alone_explains_ghosts(good: Seen) -> None:
    """One of three exposures is blurred: that warns, and says why a part differs; not why the whole object does."""
    quality = np.zeros_like(good.results.radiance.quality)
    quality[:, ::3] = int(Quality.GHOST)
    radiance = bracket(replace(good.results.radiance, quality=quality), exposure_ratio=STEPS, exif_ratio=STEPS[..., 0])
    blur = np.array([[0.0, 0, 0], [0, 0, 3.0], [0, 0, 0]])
    found = judged(changed(good, radiance=radiance, blur_px=blur))
    assert (found["sharpness"].state, found["stillness"].state) == ("warn", "not judged")
    quality[1] = int(Quality.GHOST)
    radiance = replace(radiance, quality=quality)
    gate = judged(changed(good, radiance=radiance, blur_px=blur, files=FILES))["stillness"]
    assert gate.state == "fail" and "Move pol0/2.DNG, pol1/2.DNG, pol2/2.DNG out" in gate.remedy


@pytest.mark.parametrize(
    ("frames", "brightness", "state", "rescued"),
    [
        ([(1, 2)], 0.1, "warn", True),  # the brightest frame: ghosts are taken from the reference
        ([(1, 1)], 0.1, "fail", True),
        ([(0, 0), (2, 0)], 0.1, "warn", True),
        ([(0, 0), (2, 0)], 0.99, "warn", False),  # only the darkest exposure holds the highlights
        ([(0, 0), (2, 1)], 0.1, "fail", False),  # two exposures
    ],
)
def test_the_exposure_that_a_bracket_can_do_without_is_named(
    good: Seen, frames: list[tuple[int, int]], brightness: float, state: str, rescued: bool
) -> None:
    value = np.full_like(good.results.radiance.value, brightness)
    radiance = bracket(replace(good.results.radiance, value=value), exposure_ratio=STEPS, exif_ratio=STEPS[..., 0])
    blur = np.zeros((3, 3))
    for place in frames:
        blur[place] = 2.5
    gate = judged(changed(good, radiance=radiance, blur_px=blur, files=FILES))["sharpness"]
    e = frames[0][1]
    assert gate.state == state and (f"Move pol0/{e}.DNG, pol1/{e}.DNG, pol2/{e}.DNG out" in gate.remedy) is rescued
    assert "take that shot again" in gate.remedy and (gate.cost_deg > 5) is (state == "fail")


def test_an_error_is_a_gate_unless_an_earlier_cause_explains_it(good: Seen) -> None:
    error = Gate("alignment", "fail", None, None, "shot 45° has no detail", "shoot again")
    reached = {name: value for name, value in parts(good).items() if name not in STOPPED}
    for share, names in ((0.0, ["alignment"]), (0.5, ["clipping"])):
        found = gates.judge(scenes.evidence(**{**reached, "clipped": clipped(share)}), Config().gates, error)
        assert [gate.name for gate in found if gate.state == "fail"] == names
        assert len({gate.name for gate in found}) == len(found)


def test_at_most_two_remedies_are_given_causes_first() -> None:
    def gate(name: str, state: State, cost: float = 0.0, remedy: str = "") -> Gate:
        return Gate(name, state, None, None, name, remedy or f"mend {name}", cost)

    warned = [gate("chart", "warn"), gate("gains", "warn", 2.0), gate("body", "warn", 9.0), gate("mask", "pass")]
    assert [one.name for one in advice(warned)] == ["gains", "body"]
    failed = [gate("clipping", "fail"), gate("angles", "fail", remedy="mend clipping"), *warned, gate("mesh", "fail")]
    assert [one.name for one in advice(failed)] == ["clipping", "mesh"]
    assert [one.name for one in advise(failed) if one.remedy] == ["clipping", "mesh"]
    assert [one.name for one in advise(failed)] == [one.name for one in failed]
    uncertain = [*warned, Gate("normal error", "fail", 25.0, 20.0, "")]  # its remedies are those of its causes
    assert advice(uncertain) == advice(warned)


def test_shots_of_another_scene_are_named_with_their_folder(good: Seen) -> None:
    files = tuple((f"pol{angle}/IMG.DNG",) for angle in ("000", "045", "090"))
    for correlation, name, folder in (([1, 0.9, 0.1], "90°", "pol090"), ([1, 0.1, 0.2], "0°", "pol000")):
        unlike = replace(good.results.alignment, correlation=np.array(correlation, float))
        gate = judged(changed(good, alignment=unlike, files=files))["alignment"]
        assert gate.shots == (name,) and folder in gate.remedy and name in gate.message


def test_equal_light_is_called_equal(good: Seen) -> None:
    assert "as bright as the others" in judged(good)["gains"].message
    assert not re.search(r"\b0\.0+ (%|px) (brighter|darker|more)", " ".join(g.message for g in judged(good).values()))


def test_a_clipped_capture_is_told_how_many_stops(good: Seen) -> None:
    every = np.zeros_like(good.clipped)
    for share, stops in ((0.05, 2), (0.4, 3), (0.9, 4)):
        every[:] = share
        assert f"{stops} stops less light" in judged(changed(good, clipped=every))["clipping"].remedy
    assert "as much light as the others" in judged(changed(good, clipped=clipped(0.4)))["clipping"].remedy


def test_flash_bracketed_by_the_shutter_is_named(good: Seen) -> None:
    alike = np.tile([[[1.0], [1.01], [0.99]]], (3, 1, 3))
    radiance = bracket(good.results.radiance, exposure_ratio=alike, exif_ratio=np.array([[0.25, 1, 4]] * 3))
    radiance = replace(radiance, equipment=Equipment("flash"))
    gate = judged(changed(good, radiance=radiance))["exposures"]
    assert gate.state == "warn" and "the camera states steps of 4 times" in gate.message
    assert "flash power, aperture or ISO" in gate.remedy


def test_stripes_ask_for_the_flash_synchronization_time_only_of_a_flash(good: Seen) -> None:
    striped = bracket(good.results.radiance, flicker=np.array([[np.nan, 0.05]] * 3))
    for equipment in (Equipment("flash"), Equipment("steady")):
        gate = judged(changed(good, radiance=replace(striped, equipment=equipment)))["flicker"]
        assert ("synchronization" in gate.remedy) == ("than the flash" in gate.message) == (equipment.light == "flash")


def test_grays_with_a_tone_curve_count_half_as_glare_flattens_them_too(good: Seen) -> None:
    color = replace(scenes.no_color(), place=ChartPlace(np.zeros((24, 4, 2)), np.zeros((4, 2))))
    parts = {"color": color, **with_gains(good, grey_slope=0.7)}
    gate = judged(changed(good, **parts))["tone curve"]
    assert gate.state == "fail" and gate.value == pytest.approx(0.15) and "power 0.70" in gate.message
    curved = bracket(good.results.radiance, curvature=np.array([[0.0, -0.2]] * 3))
    assert judged(changed(good, radiance=curved, **parts))["tone curve"].value == pytest.approx(0.2)


def test_gains_of_the_object_that_polarize_the_surroundings_are_in_doubt(good: Seen) -> None:
    """Its surroundings had equal light in all shots; a room's polarization does not vanish with equal gains."""
    equal = np.ones_like(good.results.selfcal.gains.gain)
    wrong = equal * np.array([1.0, 0.95, 1.0])[:, None]
    seen = judged(changed(good, **with_gains(good, source="object", gain=wrong)))
    assert seen["gain doubt"].state == "fail" and "ColorChecker" in seen["gain doubt"].remedy
    assert seen["room light"].state == "not judged"
    polarized = replace(
        good.results.radiance, value=(good.results.radiance.value * wrong[:, None, None]).astype(np.float32)
    )
    sure = with_gains(good, source="object", gain=equal)
    assert "surroundings" not in judged(changed(good, radiance=polarized, **sure))["gain doubt"].message


def test_gains_nobody_knows_cost_degrees(good: Seen) -> None:
    doubtful = with_gains(good, source="object", sigma=np.array([[0.0] * 3, [0.02] * 3, [0.02] * 3]))
    gate = judged(changed(good, **doubtful))["gain doubt"]
    assert gate.state == "warn" and 5 < gate.cost_deg < 15
    assert judged(changed(good, **doubtful))["normal error"].value > 10  # type: ignore[operator]


def test_one_angle_that_keeps_four_shots_from_closing_fails(good: Seen) -> None:
    turned = replace(good.results.selfcal, turned=TurnedShot((1,), np.radians(15), np.radians(2)))
    gate = judged(changed(good, selfcal=turned))["angles"]
    assert gate.state == "fail" and gate.shots == ("45°",) and "+15° ± 2°" in gate.message


@pytest.mark.parametrize(("turn", "state"), [(1.5, "pass"), (5.0, "warn")])
def test_a_turn_of_the_ring_is_reported_though_corrected(good: Seen, turn: float, state: str) -> None:
    turned, doubt = np.radians([turn, 0.4])
    gate = judged(changed(good, selfcal=replace(good.results.selfcal, ring=RingZero(turned, doubt, turned))))["angles"]
    assert gate.state == state and f"{turn:+.1f}°" in gate.message and "corrected" in gate.message


def shaped(good: Seen, polarized: float, flattened: float, roughness: float, dimmed: bool = True) -> Any:
    """The ball with a part of its polarization and of its tangents' slope, and whether it dims towards its outline."""
    image, maps = good.results.stokes, good.results.maps
    weak = image.stokes * np.array([1, polarized, polarized], np.float32)[:, None, None, None]
    shading = np.maximum(maps.normal[..., 2:], 0.1)
    slope = maps.normal[..., :2] / shading * flattened
    normal = np.concatenate([slope, np.ones_like(shading)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    maps = replace(maps, normal=normal, roughness=np.full_like(maps.roughness, roughness))
    weak = (weak * shading if dimmed else weak / weak[0].mean(-1)[..., None]).astype(np.float32)
    return changed(good, stokes=replace(image, stokes=weak), maps=maps)


@pytest.mark.parametrize(
    ("polarized", "flattened", "roughness", "dimmed", "words"),
    [
        (0.13, 0.4, 0.6, True, "the shape is flat"),  # wax
        (0.25, 0.4, 0.6, True, "the shape is flat"),  # wax that is not quite as bad
        (0.13, 1.0, 0.2, True, "gloss and shading"),  # no rough body shines
        (0.13, 1.0, 0.7, True, ""),  # a rough body, which the estimator has allowed for
        (0.9, 0.4, 0.2, True, ""),  # the wall of a vessel
    ],
)
def test_body_that_polarizes_too_little_for_its_shape_is_reported(
    good: Seen, polarized: float, flattened: float, roughness: float, dimmed: bool, words: str
) -> None:
    gate = judged(shaped(good, polarized, flattened, roughness, dimmed))["body"]
    assert gate.state == ("warn" if words else "pass"), gate
    assert words in gate.message and (gate.cost_deg > 5) == bool(words)


def test_a_body_that_the_network_explains_is_not_reported(good: Seen) -> None:
    """Polarization that fits no outline, of a shape that explains it; the inversion explains any polarization."""
    turned = good.results.stokes.stokes.copy()
    turned[1:, :, : turned.shape[2] // 2] *= -1
    image = replace(good.results.stokes, stokes=turned)
    for estimator, state in (("analytic", "warn"), ("network 1", "pass")):
        seen = changed(good, stokes=image, maps=replace(good.results.maps, estimator=estimator))
        assert judged(seen)["body"].state == state, estimator


def test_a_flat_object_is_one_finding_with_one_remedy(good: Seen) -> None:
    """A coin, whose polarization is too weak to judge the order of the angles, its material or the light."""
    flat = shaped(good, 0.13, 0.3, 0.2, dimmed=False)
    maps = flat.results.maps
    doubtful = replace(maps, confidence=np.full_like(maps.confidence, 15.0))
    found = judged(changed(flat, maps=doubtful))
    assert found["flat"].state == "warn" and "polcap material" in found["flat"].remedy
    assert {found[name].state for name in ("angles", "body", "other light", "lighting")} == {"not judged"}
    assert found["order"].state == "not measured"


def test_room_light_costs_what_one_ambient_frame_cannot_remove(good: Seen) -> None:
    """The object polarizes the room's light: only a frame at the same angle shows the same light."""
    share = {"ambient_share": np.full(3, 0.15)}
    one = judged(changed(good, radiance=bracket(good.results.radiance, **share, ambient_shared=True)))["ambient"]
    each = judged(changed(good, radiance=bracket(good.results.radiance, **share)))["ambient"]
    assert (one.state, each.state) == ("warn", "pass") and "per angle" in one.remedy
    assert one.cost_deg > 1 and each.cost_deg == 0


def test_light_from_both_sides_is_reported(good: Seen) -> None:
    """The brightest tenth of the object shares a polarization where two lamps mirror, not under a flash at the lens."""
    assert judged(good)["lighting"].state == "pass"
    ratio = good.results.cues.ratio.copy()
    ratio[0] += 0.01
    gate = judged(changed(good, cues=replace(good.results.cues, ratio=ratio)))["lighting"]
    assert gate.state == "warn" and gate.cost_deg == pytest.approx(2.7, abs=0.5)


def test_an_unsharp_picture_costs_degrees_before_it_warns(good: Seen) -> None:
    """A smooth object looks like one out of focus: the expected error counts the doubt."""
    sharp = scenes.before_backdrop([np.eye(3)] * 3)
    soft = replace(sharp, value=np.stack([cv2.GaussianBlur(shot, (0, 0), 1.3) for shot in sharp.value]))
    before, after = (judged(changed(good, radiance=radiance))["focus"] for radiance in (sharp, soft))
    assert (before.state, after.state) == ("pass", "pass")
    assert before.cost_deg == 0 and after.cost_deg > 0.3


@pytest.mark.parametrize("charted", [False, True])
def test_an_object_out_of_focus_is_reported_beside_a_sharp_chart_too(good: Seen, charted: bool) -> None:
    corners = np.array([[230.0, 150], [300, 150], [300, 200], [230, 200]])
    color = replace(scenes.no_color(), place=ChartPlace(np.zeros((24, 4, 2)), corners) if charted else None)
    for sigma, state in ((0.5, "pass"), (2.5, "warn")):
        value = np.stack([cv2.GaussianBlur(shot, (0, 0), sigma) for shot in good.results.radiance.value])
        value[:, 150:200, 230:300] = np.where(np.arange(70) // 14 % 2, 0.05, 0.4)[:, None].astype(np.float32)
        seen = changed(good, radiance=replace(good.results.radiance, value=value), color=color)
        gate = judged(seen)["focus"]
        assert gate.state == state
    assert ("chart's" in gate.message) == charted


def test_a_shadow_contradicts_nothing(good: Seen) -> None:
    """Where no light falls, shots show noise, which is polarized more than it is bright."""
    noise = np.random.default_rng(1).normal(size=good.results.stokes.stokes.shape).astype(np.float32)
    dark = good.results.stokes.stokes.copy()
    dark[:, 120:] = 1e-4 * noise[:, 120:]
    assert judged(changed(good, stokes=replace(good.results.stokes, stokes=dark)))["alignment"].state == "pass"


def test_a_turned_object_is_reported_in_degrees(good: Seen) -> None:
    """Detail that rolls by 1° about the object's middle, before a camera that stood still."""
    x, y = scenes.CENTER
    moved = []
    for t in np.radians([0.0, 1.0, 0.0]):
        c, s = np.cos(t), np.sin(t)
        moved.append(np.array([[c, -s, x - x * c + y * s], [s, c, y - x * s - y * c], [0, 0, 1]]))
    gate = judged(changed(good, radiance=scenes.before_backdrop(moved)))["alignment"]
    assert gate.state == "warn" and gate.unit == "°" and gate.shots == ("45°",)
    assert gate.value == pytest.approx(1.0, abs=0.15) and gate.cost_deg == pytest.approx(7.4, abs=1)  # 600 / √2 per rad


def test_light_from_around_is_reported(good: Seen) -> None:
    image = good.results.stokes
    across = image.stokes * np.array([1, -1, -1], np.float32)[:, None, None, None]
    gate = judged(changed(good, stokes=replace(image, stokes=across)))["body"]
    assert gate.state == "fail" and "reflects" in gate.message
    assert "90°" in gate.message and "plus 90°" in gate.remedy  # a ring set upright at 0° looks the same


@pytest.mark.parametrize(("azimuth", "side"), [(0.0, "right"), (np.pi / 2, "top"), (-3.0, "left")])
def test_a_lamp_at_the_side_is_found_in_the_albedo(good: Seen, azimuth: float, side: str) -> None:
    """The albedo takes the light of a lamp 40° to the side of the lens, 0.8 times the flash's (Lambert's law)."""
    maps, lamp = good.results.maps, np.radians(40)
    towards = np.array([np.cos(azimuth) * np.sin(lamp), np.sin(azimuth) * np.sin(lamp), np.cos(lamp)])
    light = 1 + 0.8 * np.maximum(maps.normal @ towards, 0) / np.maximum(maps.normal[..., 2], 0.05)
    lit = replace(maps, diffuse=(0.3 * light[..., None] * np.ones(3)).astype(np.float32))
    gate = judged(changed(good, maps=lit))["lighting"]
    assert gate.state == "warn" and f"lean to the {side} " in gate.message and 3 < gate.cost_deg < 7


def test_a_dark_and_a_bright_half_are_no_light_from_the_side(good: Seen) -> None:
    maps = good.results.maps
    random = np.random.default_rng(2)
    halves = np.where(np.arange(maps.mask.shape[1]) < maps.mask.shape[1] / 2, 0.15, 0.6) * np.ones(maps.mask.shape)
    halves = (halves * np.exp(0.05 * random.normal(size=halves.shape)))[..., None] * np.ones(3)
    painted = replace(maps, diffuse=halves.astype(np.float32))
    assert judged(changed(good, maps=painted))["lighting"].state == "pass"


def test_a_ring_that_was_mended_is_reported() -> None:
    clocked = replace(scenes.stack(noise=0.002, angles=scenes.ANGLES + np.radians(4.0)), angle=scenes.ANGLES)
    gate = judged(found(radiance=clocked))["angles"]
    assert gate.state == "warn" and gate.value == pytest.approx(4.0, abs=0.5)  # it may be a single shot's
    assert "corrected" in gate.message and 0 < gate.cost_deg < 2.5


def test_a_turned_shot_is_named_though_the_ring_was_corrected() -> None:
    """One shot that is turned by 20° imitates a smaller turn of all three, which fits worse."""
    actual = scenes.ANGLES + np.radians([0.0, 20.0, 0.0])
    seen = found(radiance=replace(scenes.stack(noise=0.002, angles=actual), angle=scenes.ANGLES))
    gate = judged(seen)["angles"]
    assert seen.results.selfcal.ring.correction != 0
    assert gate.state == "fail" and gate.shots == ("45°",) and gate.value == pytest.approx(20, abs=3)


@pytest.mark.parametrize(("name", "value"), [("border", 0.6), ("islands", 0.03), ("holes", 0.06)])
def test_mask_of_a_doubtful_shape_warns(good: Seen, name: str, value: Any) -> None:
    gate = judged(changed(good, object_=replace(good.results.object_, **{name: value})))["mask"]
    assert gate.state == "warn" and "--mask" in gate.remedy


def test_pixels_at_the_outline_of_a_thin_object_are_no_doubt_of_its_mask(good: Seen) -> None:
    wire = np.zeros_like(good.results.object_.mask)
    wire[100:106, 40:200] = True
    for doubt in (0.14, 0.3):
        thin = replace(good.results.object_, mask=wire, doubt=doubt)
        assert geometry.mask(changed(good, object_=thin), Config().gates).state == "pass"


def test_normals_of_a_difficult_object_warn_with_what_helps(good: Seen) -> None:
    """Without noise more light does not help: a small object is shown larger, another one tilted."""
    tilted = judged(changed(good, **noisy(good, 0.001)))["normal error"]
    assert tilted.state == "warn" and "Tilt" in tilted.remedy
    small = changed(good, **noisy(good, 0.001), grid_px=0.3)
    assert "larger" in judged(small)["normal error"].remedy
    assert "more light" in judged(changed(good, **noisy(good, 0.03)))["normal error"].remedy


def test_assumed_focal_length_warns_and_costs_what_the_rays_would_lean(good: Seen) -> None:
    two = float(np.log(2.0))
    gate = judged(changed(good, focal_doubt=(-two, two)))["focal length"]
    longer = judged(changed(good, focal_doubt=(0.0, two)))["focal length"]
    y, x = np.nonzero(good.results.maps.mask)
    off = (
        np.hypot(x - good.results.maps.view.center[0], y - good.results.maps.view.center[1])
        / good.results.maps.view.focal
    )
    possible = np.exp(np.random.default_rng(0).uniform(-two, two, 4000))
    lean = np.degrees(np.sqrt(np.mean((np.arctan(np.median(off) * possible) - np.arctan(np.median(off))) ** 2)))
    assert gate.state == "warn" and gate.cost_deg == pytest.approx(lean, rel=0.05)
    assert longer.state == "warn" and 0 < longer.cost_deg < gate.cost_deg


@pytest.mark.parametrize(
    ("fault", "state", "words", "unit"),
    [
        ({"pieces": 26}, "fail", "26 pieces", ""),
        ({"cuts": 2.5}, "fail", "250% of the outline", "1"),
        ({"raggedness": 0.4}, "warn", "boundary is 40%", "1"),
    ],
)
def test_mesh_in_shreds_fails_by_the_figure_that_is_over(
    good: Seen, fault: dict[str, float], state: str, words: str, unit: str
) -> None:
    whole = {"pieces": 1, "cuts": 0.3, "cut_px": 40.0, "raggedness": 0.1}
    passed = judged(changed(good, mesh=SimpleNamespace(**whole)))["mesh"]
    assert passed.state == "pass" and passed.message.startswith("1 piece, cut along 40 px")
    gate = judged(changed(good, mesh=SimpleNamespace(**whole | fault)))["mesh"]
    assert gate.state == state and words in gate.message
    (figure,) = fault.values()
    assert (gate.value, gate.unit) == (figure, unit) and not _within(gate, least=False)


def _within(gate: Gate, least: bool) -> bool:
    """Whether the gate's figure keeps to its limit, where both are numbers."""
    value, limit = gate.value, gate.limit
    if not (isinstance(value, float | int) and isinstance(limit, float | int)):
        return False
    return value >= limit if least else value <= limit


def test_a_gate_s_value_is_the_figure_of_its_message(good: Seen) -> None:
    object_, still, image = good.results.object_, good.results.alignment, good.results.stokes
    unlike, unsure = np.array([1, 0.1, 1]), np.array([0, 0.5, 0])
    around = image.stokes * np.array([1, -1, -1], np.float32)[:, None, None, None]
    turned = image.stokes.copy()
    turned[1:, :, : image.mask.shape[1] // 2] *= -1
    dull = shaped(good, 0.13, 0.4, 0.6)
    for name, least, fields in (
        ("mask", False, {"object_": replace(object_, border=0.6, doubt=0.02)}),
        ("mask", False, {"object_": replace(object_, holes=0.3, doubt=0.02)}),
        ("mask", False, {"object_": replace(object_, doubt=0.2)}),
        ("alignment", True, {"alignment": replace(still, correlation=unlike)}),
        ("alignment", False, {"alignment": replace(still, residual_px=unsure)}),
        ("body", True, {"stokes": replace(image, stokes=around)}),
        ("body", True, {"stokes": replace(image, stokes=turned)}),
        ("body", True, {"stokes": dull.results.stokes, "maps": dull.results.maps}),
    ):
        gate = judged(changed(good, **fields))[name]
        assert gate.state in ("warn", "fail") and not _within(gate, least), gate


@pytest.mark.parametrize(("turned", "state"), [(0.0, "pass"), (0.03, "pass"), (0.3, "fail")])
def test_a_shape_that_is_turned_inside_out_fails_at_its_outline(good: Seen, turned: float, state: str) -> None:
    """A ball of which a sector is its half-turn about the ray: as much of its outline points inward."""
    rows, columns = np.mgrid[: good.results.maps.mask.shape[0], : good.results.maps.mask.shape[1]]
    y, x = (part - part[good.results.maps.mask].mean() for part in (rows, columns))
    around = np.arctan2(y, x) / (2 * np.pi) + 0.5
    local = np.where((around < turned)[..., None], [-1, -1, 1], 1) * scenes.truth()[0]
    view = frames.rays(good.results.maps.view, *good.results.maps.mask.shape)
    normal = frames.from_ray_frame(local, view).astype(np.float32)
    gate = judged(changed(good, maps=replace(good.results.maps, normal=normal)))["outline"]
    assert gate.state == state
    assert gate.value == pytest.approx(turned, abs=0.02)


def test_four_angles_are_not_asked_of_who_has_shot_four(good: Seen) -> None:
    four = found(angles=np.radians([0.0, 45, 90, 135]))
    for of, asked in ((good, True), (four, False)):
        sigma = np.full_like(of.results.selfcal.gains.sigma, 0.2)
        doubtful = judged(changed(of, **with_gains(of, source="object", sigma=sigma)))
        assert ("four angles" in doubtful["gain doubt"].remedy) == asked
        assert doubtful["gain doubt"].state == doubtful["normal error"].state == "fail"


def test_a_passing_mask_tells_its_figure(good: Seen) -> None:
    gate = judged(changed(good, object_=replace(good.results.object_, doubt=0.024)))["mask"]
    assert gate.state == "pass" and "2.4 %" in gate.message


@pytest.mark.parametrize(
    ("scatter", "gain_sigma", "state"), [(0.0, 0.001, "warn"), (0.5, 0.001, "pass"), (0.0, 0.005, "pass")]
)
def test_a_shared_polarization_within_its_error_is_no_light_from_the_side(
    good: Seen, scatter: float, gain_sigma: float, state: str
) -> None:
    """A part of the brightest pixels differs by far more than all share, or the light of the shots is in doubt."""
    ratio, selfcal = good.results.cues.ratio.copy(), good.results.selfcal
    ratio[0] += 0.006
    ratio += scatter * np.random.default_rng(0).choice([-1, 0, 0, 0, 1], ratio.shape)
    known = replace(selfcal, gains=replace(selfcal.gains, sigma=np.full_like(selfcal.gains.sigma, gain_sigma)))
    seen = changed(good, cues=replace(good.results.cues, ratio=ratio), selfcal=known)
    assert judged(seen)["lighting"].state == state
