"""Every gate in every state becomes JSON, also where it judges NumPy scalars.

For a new gate: a case per state in CASES; a good value of its figure in FIGURES, and the function that measures it in
MEASURES, so that cases can state the figure.
"""

import json
import re
from dataclasses import is_dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from polcap.capture_values import AngleStatement, ShotOrder
from polcap.chart_values import PatchColors
from polcap.config import Config
from polcap.image_values import Quality
from polcap.quality import flatness, gates, geometry, light, polarization, rerendering, rim, shot_exposure
from polcap.quality.albedo_slope import AlbedoSlope
from polcap.quality.flatness import Flatness
from polcap.quality.gate_values import Gate
from polcap.quality.object_turn import ObjectTurn
from polcap.quality.rerendering import Rerendering
from polcap.stage_values import AngleStack, BlackError, Equipment, OrderTest, OutlineCheck, RingZero, TurnedShot
from polcap.stages.align.object_motion import ObjectShift
from tests import scenes
from tests.quality.test_gates import clipped

NAN = float("nan")


def pushed(second: float, third: float = 0.0, sigma: float = 0.1) -> ObjectShift:
    return ObjectShift(np.array([0.0, second, third]), np.array([0.0, sigma, sigma]))


def network_maps(albedo_sigma: float | None, ratio: float | None = None) -> SimpleNamespace:
    """Maps of a network that expects `ratio` times the errors for another order."""
    order = None if ratio is None else OrderTest(ShotOrder((2, 1, 0)), ratio)
    return SimpleNamespace(estimator="network", albedo_sigma=albedo_sigma, order=order)


def turned(degrees: float, sigma: float) -> ObjectTurn:
    """The second shot turned by so many degrees."""
    return ObjectTurn(np.array([0.0, degrees, 0.0]), np.full(3, sigma), *np.zeros((2, 3)))


def rendered(agreement: float = 0.7, scale: float = 1.0) -> Rerendering:
    return Rerendering(np.zeros(0), np.zeros(0), np.zeros(0), scale, agreement)


BODY = {
    "dolp": 0.1, "dolp_most": 0.1, "along": 0.9, "concentration": 0.95, "turned": 0.0,
    "turned_sigma": 0.01, "brightness": 0.5,
}  # fmt: skip
TURN = {"shot": None, "angle": 0.0, "misfit": 1.0, "sigmas": 0.0}
ROUNDED = Flatness(contour=0.8, common=0.1, rim_dolp=0.2, rim_light=0.7, aligned=0.7, facing=1.0, expected_deg=15.0)
EDGES = replace(ROUNDED, common=0.9)  # of flat faces
BOX = replace(EDGES, contour=0.2, expected_deg=6.0)
BLOCK = replace(ROUNDED, aligned=0.95)  # faces the camera
PLANE = replace(EDGES, aligned=0.95)
SHEET = replace(ROUNDED, contour=0.08, rim_light=1.1, aligned=0.8, expected_deg=28.0)  # crumpled
FIGURES = {
    "inward_outline": 0.0, "surroundings": 0.001, "highlight": 0.001,
    "albedo_slope": AlbedoSlope(0.01, 0.1),
    "pushed": pushed(0.1, 0.1), "turn": turned(0.2, 0.1),
    "edge_blur": (0.8, 0.9), "contradiction": 0.0, "own_error": 4.0,
    "flatness": ROUNDED, "most_dolp": 0.1, "charted": 0.0, "rendered": rendered(), "noise": 0.001, "ill_posed": 0.0,
    "medians": [45.0, 0.2, 0.3],
    "normal_error": 4.0, "lean": 2.0, "crossed": light.CrossedFigures(0.0, 0, 0.0, 0.1),
}  # fmt: skip
MEASURES = {  # the function that measures each figure
    "surroundings": (light, "surroundings_dolp"), "highlight": (light, "_highlight_dolp"),
    "albedo_slope": (light, "_albedo_slope"),
    "contradiction": (geometry, "_contradiction"),
    "pushed": (geometry, "_measure_shift"), "turn": (geometry, "_measure_turn"),
    "edge_blur": (geometry, "_edge_blurs"),
    "rendered": (rerendering, "measure"), "own_error": (polarization, "_own_error_deg"),
    "charted": (geometry, "_chart_share"), "lean": (geometry, "_median_ray_doubt_deg"),
    "noise": (shot_exposure, "noise_dolp"), "crossed": (light, "_compare_crossed"),
    "ill_posed": (polarization, "_ill_posed"), "medians": (polarization, "_medians"),
    "outline": (polarization, "_outline"), "flatness": (flatness, "measure"), "most_dolp": (polarization, "_most_dolp"),
    "normal_error": (gates, "_median_error"), "inward_outline": (geometry, "_inward_share"),
}  # fmt: skip
MESH = {"pieces": 1, "cuts": 0.3, "cut_px": 40.0, "raggedness": 0.1}
SMALL = np.hypot(*np.mgrid[-scenes.HEIGHT // 2 : scenes.HEIGHT // 2, -scenes.WIDTH // 2 : scenes.WIDTH // 2]) < 30
FAR = np.array([[[1.0, 0, 50 * k], [0, 1, 0], [0, 0, 1]] for k in range(3)])
CUES = SimpleNamespace(ratio=np.full((2, 1, 50), 0.02), mask=np.ones((1, 50), bool))  # S1/S0 and S2/S0
GAINS = replace(scenes.equal().gains, source="grey patches")
STATED = ShotOrder((0, 1, 2))


def gains(**fields: Any) -> dict[str, Any]:
    """Self-calibration with these fields of its gains."""
    return {"selfcal": {"gains": replace(GAINS, **fields)}}


def in_numpy(value: Any) -> Any:
    """The same plain data with a NumPy scalar for every number."""
    if isinstance(value, dict):
        return {name: in_numpy(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(in_numpy(one) for one in value)
    if isinstance(value, float):
        return np.float64(value)
    if is_dataclass(value):
        return fields_in_numpy(value)
    return np.int64(value) if isinstance(value, int) and not isinstance(value, bool) else value


def exposures(*ratio: float, **fields: Any) -> dict[str, Any]:
    """Measurements of brackets with these exposures relative to the reference's."""
    each = np.array(ratio)[None, :, None]
    return {"exposure_ratio": np.tile(each, (3, 1, 3)), "exif_ratio": np.tile(each[..., 0], (3, 1)), **fields}


def outline(turn: dict[str, Any] | None = None, side: float = 0.02, **body: float) -> dict[str, Any]:
    """Measured figures with this outline."""
    found = rim.RimFigures(**in_numpy(BODY | body)), rim.AngleError(**in_numpy(TURN | (turn or {})))
    return {"outline": polarization.OutlineFigures(*found, np.array([0.0, 0.01, side]))}


def ghosts() -> Any:
    """(K, H, W): quality of three shots, the second one a ghost all over."""
    quality = np.zeros((3, *scenes.ball_object().mask.shape), np.uint8)
    quality[1] = int(Quality.GHOST)
    return quality


UNCLEAR = {"selfcal": {"outline": OutlineCheck(STATED, 0.9, ShotOrder((0, 2, 1)))}}
CASES: list[tuple[str, str, dict[str, Any]]] = [  # gate, its state, the fields that lead to it
    ("exposures", "pass", {}),
    ("exposures", "warn", {"bracket": exposures(1.0)}),
    ("exposures", "warn", {"bracket": exposures(1.0, 1.01, exif_ratio=np.array([[1.0, 4.0]] * 3))}),
    ("exposures", "warn", {"bracket": exposures(1.0, 1.2)}),
    ("exposures", "warn", {"bracket": exposures(1.0, 40.0)}),
    ("tone curve", "pass", {}),
    ("tone curve", "fail", {"bracket": {"curvature": np.array([[0.0, -0.2]] * 3)}}),
    ("source", "pass", {}),
    ("source", "warn", {"sensor": {"lossy": True}}),
    ("black level", "pass", {}),
    ("black level", "pass", {"bracket": {"black": BlackError(np.full(3, 5e-4), True)}}),
    ("black level", "warn", {"bracket": {"black": BlackError(np.full(3, -5e-3), True)}}),
    ("black level", "warn", {"bracket": {"black": BlackError(np.full(3, 5e-3))}}),
    ("black level", "not measured", {"bracket": exposures(1.0)}),
    ("flicker", "pass", {"bracket": {"flicker": np.array([[NAN, 0.002]] * 3)}}),
    ("flicker", "warn", {"bracket": {"flicker": np.array([[NAN, 0.01]] * 3)}}),
    ("flicker", "fail", {"bracket": {"flicker": np.array([[NAN, 0.05]] * 3)}}),
    ("flicker", "pass", {"bracket": {"flicker": np.array([[NAN, 0.05], [NAN, 0.001], [NAN, NAN]])}}),  # a hand
    ("flicker", "not measured", {}),
    ("stillness", "pass", {}),
    ("stillness", "fail", {"radiance": {"quality": ghosts()}}),
    ("chart", "pass", {"color": {"patches": PatchColors(np.full(24, 1.0))}}),
    ("chart", "fail", {"color": {"patches": PatchColors(np.full(24, 9.0))}}),
    ("chart", "warn", {"chart_missing": "nothing like one"}),
    ("chart", "not measured", {}),
    ("chart", "not measured", {"chart_missing": "nothing like one", "later_view": True}),
    ("alignment", "fail", {"figures": {"contradiction": 0.5}}),
    ("alignment", "pass", {}),
    ("alignment", "fail", {"alignment": {"transform": FAR}}),
    ("alignment", "fail", {"alignment": {"correlation": np.array([1.0, 0.1, 1.0])}}),
    ("alignment", "warn", {"alignment": {"residual_px": np.array([0.0, 0.5, 0.0])}}),
    ("alignment", "fail", {"alignment": {"residual_px": np.array([0.0, 0.5, 0.0]), "correlation": np.full(3, 0.7)}}),
    ("alignment", "fail", {"alignment": {"transform": np.full((3, 3, 3), NAN)}}),
    ("alignment", "warn", {"figures": {"pushed": pushed(1.2)}}),
    ("alignment", "warn", {"figures": {"turn": turned(0.9, 0.1)}}),
    ("alignment", "pass", {"figures": {"turn": turned(0.8, 0.2)}}),
    ("alignment", "warn", {"figures": {"pushed": pushed(1.8, sigma=0.2)}}),
    ("alignment", "pass", {"figures": {"pushed": pushed(1.8, sigma=0.9)}}),
    ("alignment", "fail", {"figures": {"pushed": pushed(5.0)}}),
    ("alignment", "fail", {"figures": {"pushed": pushed(np.inf)}}),
    ("mask", "pass", {}),
    ("mask", "pass", {"object_": {"doubt": None}}),
    ("mask", "not measured", {"object_": {"doubt": None, "source": "automatic"}}),
    ("mask", "warn", {"object_": {"border": 0.3}}),
    ("mask", "fail", {"object_": {"doubt": 0.4}}),
    ("mask", "fail", {"figures": {"charted": 0.1}}),
    ("clipping", "pass", {}),
    ("clipping", "pass", {"clipped": clipped(0.0005)}),
    ("clipping", "warn", {"clipped": clipped(0.002)}),
    ("clipping", "fail", {"clipped": clipped(0.3)}),
    ("sharpness", "pass", {"blur_px": np.array([[0.0, 0.1]] * 3)}),
    ("sharpness", "warn", {"blur_px": np.array([[0.0, 2.0]] * 3)}),
    ("sharpness", "fail", {"blur_px": np.array([[2.0, 2.0]] * 3)}),
    ("sharpness", "not measured", {}),
    ("sharpness", "not measured",
     {"blur_px": np.array([[0.0, 0.1]] * 3), "alignment": {"transform": FAR}}),
    ("focus", "pass", {}),
    ("focus", "warn", {"figures": {"edge_blur": (2.5, 2.4)}}),
    ("focus", "warn", {"figures": {"edge_blur": (1.6, 0.9)}}),  # the object alone
    ("focus", "pass", {"figures": {"edge_blur": (1.45, 0.9)}}),  # a ball
    ("focus", "warn", {"figures": {"edge_blur": (1.45, float("nan"))}}),
    ("focus", "not measured", {"grid_px": 3.0}),
    ("gains", "pass", {}),
    ("gains", "warn", gains(gain=np.array([[1.0] * 3, [1.0] * 3, [0.75] * 3]))),
    ("gains", "fail", gains(gain=np.array([[1.0] * 3, [1.0] * 3, [1.25] * 3]))),
    ("gains", "fail", gains(gain=np.array([[1.0] * 3, [0.7] * 3, [1.2] * 3]))),
    ("energy", "pass", {}),
    ("energy", "warn", {"bracket": {"exposure_ratio": np.array([[[1.0], [4.0]], [[1.0], [4.0]], [[1.0], [4.8]]])}}),
    ("energy", "fail", {"bracket": {"exposure_ratio": np.array([[[1.0], [4.0]], [[1.0], [4.0]], [[1.0], [6.0]]])}}),
    ("gain doubt", "pass", {}),
    ("gain doubt", "pass", gains(source="one exposure")),
    ("gain doubt", "pass", gains(disagreement=0.05)),
    ("gain doubt", "fail", {**gains(disagreement=0.05), "figures": {"rendered": rendered(0.3)}}),
    ("gain doubt", "pass", {**gains(disagreement=0.05), "figures": {"rendered": rendered(0.3), "flatness": EDGES}}),
    ("gain doubt", "fail", gains(source="object", sigma=np.full((3, 3), 0.12))),
    ("gain doubt", "warn", {**gains(source="object", sigma=np.full((3, 3), 0.12)), "figures": {"flatness": EDGES}}),
    ("gain doubt", "fail", {**gains(source="object", sigma=np.full((3, 3), 0.12)),
                            "figures": {"flatness": EDGES, "surroundings": 0.1}}),
    ("gain doubt", "fail", gains(sigma=np.full((3, 3), 0.31))),
    ("gain doubt", "warn", gains(chart_gloss=0.05)),
    ("gain doubt", "warn", gains(source="object", sigma=np.full((3, 3), 0.02))),
    ("gain doubt", "fail", gains(source="none", sigma=np.full((3, 3), 0.2))),
    ("gain doubt", "not measured", gains(source="none", sigma=np.full((3, 3), NAN))),
    ("order", "pass", {}),
    ("order", "warn", {**UNCLEAR, "figures": {"rendered": rendered(0.35)}}),
    ("order", "pass", {**UNCLEAR, "figures": {"rendered": rendered(0.45)}}),
    ("order", "warn", {**UNCLEAR, "maps": network_maps(0.1, 0.95), "figures": {"rendered": rendered(0.45)}}),
    ("order", "fail", {"selfcal": {"outline": OutlineCheck(ShotOrder((2, 1, 0)), 0.9)}}),
    ("order", "not measured", {"figures": {"flatness": EDGES}}),
    ("order", "not measured", {"selfcal": {"outline": OutlineCheck(ShotOrder((2, 1, 0)), 0.9)},
                               "figures": {"flatness": EDGES}}),
    ("order", "fail", {"maps": network_maps(0.1, 0.5), "figures": {"flatness": EDGES}}),
    ("order", "pass", {"maps": network_maps(0.1, 2.0), "figures": {"flatness": EDGES}}),
    ("order", "not measured", {"maps": network_maps(0.1, 0.8), "figures": {"flatness": PLANE}}),
    ("order", "not measured", {"maps": network_maps(0.1, 0.84), "figures": {"flatness": SHEET}}),
    ("order", "fail", {"maps": network_maps(0.1, 0.4), "figures": {"flatness": SHEET, "rendered": rendered(0.5)}}),
    ("flat", "warn", {"maps": network_maps(0.1, 0.84), "figures": {"flatness": SHEET}}),
    ("order", "warn", {"maps": network_maps(0.1, 0.5), "figures": {"flatness": PLANE}}),
    ("order", "fail", {"maps": network_maps(0.1, 0.5), "figures": {"flatness": PLANE, "rendered": rendered(0.5)}}),
    ("order", "fail", {"maps": network_maps(0.1, 0.5)}),
    ("order", "warn", {"maps": network_maps(0.1, 0.5), "figures": {"flatness": BOX}}),
    ("order", "fail", {"maps": network_maps(0.1, 0.5), "figures": {"flatness": BOX, "rendered": rendered(0.5)}}),
    ("order", "warn", {"maps": network_maps(0.1, 0.7), "figures": {"flatness": PLANE, "rendered": rendered(0.2)}}),
    ("order", "not measured", {"maps": network_maps(0.1, 0.7),
                               "figures": {"flatness": replace(PLANE, rim_dolp=0.03), "rendered": rendered(0.2)}}),
    ("order", "pass", {"maps": network_maps(0.1, 2.0)}),
    ("order", "fail", {"maps": network_maps(0.1, 0.8)}),
    ("order", "pass", {"maps": network_maps(0.1, 0.8),
                       "object_": {"mask": SMALL}}),
    ("angles", "pass", {}),
    ("angles", "not measured", {"figures": {"outline": None}}),
    ("angles", "fail", {"figures": outline(turned=0.3)}),
    ("angles", "fail", {"selfcal": {"turned": TurnedShot((1,), 0.3, 0.02)}}),
    ("angles", "fail", {"figures": outline({"shot": 1, "angle": 0.3, "misfit": 0.2, "sigmas": 9.0})}),
    ("angles", "warn", {"figures": outline({"shot": 1, "angle": 0.3, "misfit": 0.6, "sigmas": 9.0})}),
    ("angles", "fail", {"figures": outline({"shot": 1, "angle": -np.pi / 4, "misfit": 0.2, "sigmas": 9.0})}),
    ("angles", "warn", {"selfcal": {"found_sigma": 0.02}}),
    ("angles", "warn", {"selfcal": {"ring": RingZero(0.2, 0.01)}}),
    ("angles", "pass", {"selfcal": {"ring": RingZero(0.03, 0.01, 0.03)}}),
    ("polarized", "fail", {"figures": {"most_dolp": 0.004, "rendered": rendered(0.13)}}),
    ("polarized", "fail", {"figures": {"most_dolp": 0.004, "rendered": rendered(0.04), "flatness": BLOCK}}),
    ("body", "pass", {}),
    ("body", "fail", {"figures": outline(along=-0.9)}),
    ("body", "warn", {"figures": {**outline(along=-0.9), "medians": [45.0, 0.2, 0.04]}}),
    ("body", "warn", {"figures": {**outline(concentration=0.3), "rendered": rendered(0.3)}}),
    ("body", "pass", {"figures": {**outline(concentration=0.3), "rendered": rendered(0.35)}}),
    ("body", "not judged", {"figures": {"flatness": replace(ROUNDED, common=0.9)}}),
    ("body", "not judged", {"figures": {"flatness": replace(ROUNDED, aligned=0.95, rim_light=0.94)}}),
    ("flat", "pass", {}),
    ("flat", "warn", {"figures": {"flatness": replace(ROUNDED, common=0.9, aligned=0.95)}}),
    ("flat", "pass", {"figures": {"flatness": replace(ROUNDED, common=0.9, aligned=0.95, expected_deg=5.0)}}),
    ("flat", "not measured", {"figures": {"flatness": None}}),
    ("contour", "pass", {}),
    ("contour", "not measured", {"figures": {"flatness": EDGES}}),
    ("body", "warn", {"figures": {**outline(dolp=0.02), "medians": [10.0, 0.6, 0.3], "rendered": rendered(0.3)}}),
    ("body", "warn", {"figures": {**outline(dolp=0.02), "rendered": rendered(0.3)}}),
    ("other light", "pass", {}),
    ("other light", "fail", {"figures": outline(side=0.2)}),
    ("noise", "pass", {}),
    ("noise", "warn", {"figures": {"noise": 0.045}}),
    ("noise", "fail", {"figures": {"noise": 0.1}}),
    ("noise", "not measured", {"figures": {"noise": NAN}}),
    ("ambient", "pass", {"bracket": {"ambient_share": np.full(3, 0.001)}}),
    ("ambient", "pass", {"bracket": {"ambient_share": np.full(3, 0.15)}}),
    ("ambient", "warn", {"bracket": {"ambient_share": np.full(3, 0.15), "ambient_shared": True}}),
    ("ambient", "fail", {"bracket": {"ambient_share": np.full(3, 0.4)}}),
    ("ambient", "fail", {"bracket": {"ambient_share": np.array([0.15, 1e-9, 0.15])}}),  # a black one
    ("ambient", "fail", {"bracket": {"ambient_share": np.array([0.01, 0.01, 0.2])}}),  # one with the flash
    ("ambient", "pass", {"bracket": {"ambient_share": np.array([0.1, 0.2, 0.25])}}),  # polarized
    ("ambient", "pass", {"bracket": {"ambient_share": np.array([0.01, 1e-9, 0.001])}}),
    ("lighting", "pass", {}),
    ("lighting", "warn", {"figures": {"highlight": 0.05}}),
    ("lighting", "fail", {"figures": {"highlight": 0.3}}),
    ("lighting", "warn", {"figures": {"albedo_slope": AlbedoSlope(0.3, 0.1)}}),
    ("lighting", "not measured", {"figures": {"highlight": NAN, "albedo_slope": None}}),
    ("room light", "pass", {}),
    ("room light", "warn", {"figures": {"surroundings": 0.05}}),
    ("ambient", "not measured", {}),
    ("crossed", "pass", {"radiance": {"crossed": True}}),
    ("crossed", "warn", {"radiance": {"crossed": True}, "stokes": SimpleNamespace(body=None)}),
    ("crossed", "warn", {"radiance": {"crossed": True},
                         "figures": {"crossed": light.CrossedFigures(0.9, 99, 0.0, 0.1)}}),
    ("crossed", "warn", {"radiance": {"crossed": True},
                         "figures": {"crossed": light.CrossedFigures(0.0, 0, 0.9, 0.1)}}),
    ("ill-posed", "pass", {}),
    ("ill-posed", "fail", {"figures": {"ill_posed": 0.5}}),
    ("outline", "pass", {}),
    ("outline", "not judged", {"figures": {"inward_outline": 0.3, "flatness": EDGES}}),
    ("outline", "fail", {"figures": {"inward_outline": 0.3}}),
    ("re-rendering", "not measured", {"figures": {"rendered": replace(rendered(0.13), significance=1.3),
                                                  "flatness": BLOCK}}),
    ("re-rendering", "fail", {"figures": {"rendered": replace(rendered(0.13), significance=1.3)}}),
    ("re-rendering", "pass", {}),
    ("re-rendering", "fail", {"figures": {"rendered": rendered(agreement=-0.5)}}),
    ("re-rendering", "fail", {"figures": {"rendered": rendered(scale=0.4)}}),
    ("re-rendering", "fail", {"figures": {"rendered": rendered(scale=2.5)}}),
    ("re-rendering", "not measured", {"figures": {"rendered": rendered(agreement=NAN)}}),
    ("albedo scale", "pass", {}),
    ("albedo scale", "warn", {"maps": network_maps(0.5)}),
    ("albedo scale", "warn", {"maps": network_maps(None)}),
    ("albedo scale", "not measured", {"chart_missing": "nothing like one", "later_view": True}),
    ("focal length", "pass", {}),
    ("focal length", "warn", {"focal_doubt": (-0.7, 0.7)}),
    ("normal error", "pass", {}),
    ("normal error", "warn", {"figures": {"normal_error": 40.0}}),
    ("normal error", "fail", {"figures": {"normal_error": 30.0, "noise": 0.035}}),
    ("normal error", "not measured", {"figures": {"normal_error": NAN}}),
    ("mesh", "pass", {}),
    ("mesh", "fail", {"mesh": SimpleNamespace(**MESH | {"pieces": 99})}),
    ("mesh", "warn", {"mesh": SimpleNamespace(**MESH | {"raggedness": 0.9})}),
]  # fmt: skip


def fields_in_numpy(value: Any) -> Any:
    """A dataclass or settings with a NumPy scalar for every number among its fields."""
    struct = isinstance(value, msgspec.Struct)
    names = value.__struct_fields__ if struct else list(vars(value))
    numbers = {name: in_numpy(one) for name in names if isinstance(one := getattr(value, name), float | int)}
    return msgspec.structs.replace(value, **numbers) if struct else replace(value, **numbers)


def with_field(radiance: AngleStack, name: str, change: dict[str, Any]) -> AngleStack:
    """Merged shots with fields of one of their parts replaced."""
    return replace(radiance, **{name: replace(getattr(radiance, name), **change)})


@pytest.fixture(scope="module")
def good() -> dict[str, Any]:
    """The parts of a capture of which every gate passes or has nothing to judge."""
    return {
        "names": ["0°", "45°", "90°"], "focal_doubt": (0.0, 0.0), "grid_px": 1.0, "chart_missing": "",
        "clipped": clipped(), "blur_px": np.full((3, 2), np.nan),
        "radiance": with_field(scenes.stack(), "bracket", exposures(1.0, 4.0)),
        "color": scenes.no_color(), "alignment": scenes.still(), "object_": replace(scenes.ball_object(), doubt=0.01),
        "selfcal": replace(scenes.equal(), gains=GAINS, outline=OutlineCheck(STATED, 0.95)),
        "stokes": SimpleNamespace(body=True), "cues": CUES, "maps": network_maps(0.1),
        "mesh": SimpleNamespace(**MESH),
        "figures": FIGURES | outline(),
    }  # fmt: skip


@pytest.fixture(scope="module")
def config() -> Config:
    """Settings, whose numbers are NumPy scalars too."""
    default = Config()
    return msgspec.structs.replace(default, gates=fields_in_numpy(default.gates), align=fields_in_numpy(default.align))


def judge(good: dict[str, Any], config: Config, fields: dict[str, Any]) -> list[Gate]:
    """All gates of the good capture with some parts, or fields of its parts, replaced."""
    parts = dict(good)
    for name, change in fields.items():
        if name == "figures":
            parts[name] = good[name] | change
        elif name in ("bracket", "sensor"):
            parts["radiance"] = with_field(parts["radiance"], name, change)
        else:
            parts[name] = replace(good[name], **change) if isinstance(change, dict) else change
    for name in ("color", "object_", "radiance"):
        parts[name] = fields_in_numpy(parts[name])
    selfcal = fields_in_numpy(parts["selfcal"])
    inner = {name: fields_in_numpy(getattr(selfcal, name)) for name in ("gains", "outline", "ring", "turned")}
    parts["selfcal"] = replace(selfcal, **inner)
    for name in ("focal_doubt", "grid_px"):
        parts[name] = in_numpy(parts[name])
    parts["mesh"] = SimpleNamespace(**in_numpy(vars(parts["mesh"])))
    figures = parts.pop("figures")
    with pytest.MonkeyPatch.context() as patch:
        for figure, (module, function) in MEASURES.items():
            patch.setattr(module, function, partial(stated, in_numpy(figures[figure])))
        return gates.judge(scenes.evidence(**parts, align=config.align), config.gates)


def stated(figure: Any, *_: Any) -> Any:
    """In place of a measurement."""
    return figure


@pytest.mark.parametrize(("name", "state", "fields"), CASES)
def test_every_state_of_every_gate_becomes_json(
    good: dict[str, Any], config: Config, name: str, state: str, fields: dict[str, Any]
) -> None:
    judged = judge(good, config, fields)
    assert {gate.name: gate.state for gate in judged}[name] == state
    assert {gate.name for gate in judged} <= {name for name, _, _ in CASES}  # every gate has cases
    text = json.dumps(msgspec.to_builtins(judged), allow_nan=False)
    assert msgspec.json.decode(text, type=list[Gate]) == judged


def test_a_polarization_sensor_gets_no_advice_about_rings_or_folders(good: dict[str, Any], config: Config) -> None:
    """Its angles come from one exposure: no shot can be taken again, and no other lamp was on in one of them."""
    cells = AngleStatement("cells", cells=((1, 1), (0, 1), (0, 0)))
    radiance = replace(good["radiance"], equipment=Equipment("one exposure", angles=cells))
    for name, state, fields in CASES:
        if name not in ("order", "angles", "polarized", "body", "other light") or "radiance" in fields:
            continue
        if state == "not judged":
            continue
        gate = {gate.name: gate for gate in judge(good, config, {"radiance": radiance, **fields})}[name]
        assert not re.search(r"\bring|folder|again|clockwise|polarizer", gate.remedy.replace("the sensor", "")), gate
        assert name != "other light" or gate.state == "pass", state
