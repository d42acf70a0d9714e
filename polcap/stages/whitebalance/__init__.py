"""Stage 2: from the ColorChecker in the reference shot, the matrix that turns camera channels into colours.

The chart is looked for in 8-bit gamma pictures of the merged radiance, at several scales and exposures,
and placed to a fraction of a pixel on the radiance itself (`stages/whitebalance/chart.py`). Its patches are then
sampled in the linear radiance. A find counts only if detector, drawing and colours all agree with a
ColorChecker Classic.

References
----------
McCamy, Marcus, Davidson, A Color-Rendition Chart, J. Applied Photographic Engineering 1976.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.errors import ChartError
from polcap.images import AngleStack, ChartReference, ChartRequest, ColorCalibration, Floats, View
from polcap.stages import stage
from polcap.stages.whitebalance import chart, chart_light, patches
from polcap.stages.whitebalance.chart import Placement
from polcap.stages.whitebalance.patches import ChartFit

_WORK_PITCH_PX = 32.0  # the chart is placed at no more pixels per patch than this
_NEAR_PITCH_PX, _LAST_STEPS = 10.0, 4  # first at these, which lead to within .01 patch; then so many steps are left
_LEAST_PITCH_PX = 8.0  # below, a patch has too few pixels to be sampled
_TILE_PX, _TILE_STEP_PX = 900, 600
_GAMMA = (255 * np.linspace(0, 1, 2**14) ** (1 / 2.2)).astype(np.uint8)
_CLEARLY_BETTER = 0.5  # of the residual: of 15 photographs none comes below .93 with another edition
_SMALL_PART = 0.05  # of the variance that edges of patches under ten pixels take: colors decide there
_QUICK_SIDE = 600  # px of the picture that is looked at first, in a tenth of the time
# of that look: the detector's own parameters for a picture of .4 times its side, and five thresholds in place of nine
_QUICK = {
    "minImageSize": 400,
    "minContourLengthAllowed": 40,
    "minContoursArea": 16.0,
    "adaptiveThreshWinSizeMin": 9,
    "adaptiveThreshWinSizeMax": 61,
    "adaptiveThreshWinSizeStep": 12,
}
_CANDIDATES = 3  # per picture: texture may look more like a chart than the chart
_REMEDY = "give its corners with --chart x0,y0,…,x3,y3, a profile with --chart FILE, or --no-chart"


class WhitebalanceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `whitebalance` of a settings file."""

    chart: Annotated[
        Literal["classic", "classic_before_2014", "classic_srgb", "sg"],
        Meta(
            description="kind of chart; classic: the edition since 2014 unless another suits its colors much better; "
            "of a (Digital) SG the block E2 to J5, whose corners --chart states"
        ),
    ] = "classic"
    chart_width_m: (
        Annotated[float, Meta(gt=0, le=2, description="chart between its outer patch corners, unset: unknown [m]")]
        | None
    ) = None
    max_cost: Annotated[float, Meta(gt=0, le=1, description="greatest accepted cost of the chart detector")] = 0.06
    max_delta_e: Annotated[
        float, Meta(gt=0, le=100, description="greatest accepted mean residual of the patches [CIEDE2000]")
    ] = 15.0
    min_explained: Annotated[
        float,
        Meta(ge=0, le=1, description="least share of the chart's variance that 24 flat patches explain"),
    ] = 0.9
    patch_share: Annotated[float, Meta(ge=0.2, le=0.95, description="sampled share of each patch's side")] = 0.6


@stage(version=7)
def measure(
    radiance: AngleStack, reference: ChartReference, request: ChartRequest, settings: WhitebalanceSettings
) -> ColorCalibration:
    """The color matrix of a capture, on the scale of S0 = I₀ + I₉₀, with the chart's place and residuals.

    The patches of the reference shot give 2·I = S0, for a matt chart that faces the camera is unpolarized.
    The matrix holds at the white patch, less the chart's glare: matrix @ S0 = reflectance + glare there. What the patch
    got less light than one that faces the flash is told by `light`, and taken out with the object's place in `cues`.
    `delta_e` is NaN for patches left out because they are over-exposed. `metres_per_px` needs
    `settings.chart_width_m`: nothing is assumed about the chart's size.

    Parameters
    ----------
    radiance
        The shots (K, H, W, 3); the first is searched.
    reference
        Colors of the chart's patches.
    request
        Search, corners, a profile, or no chart.
    settings
        What is accepted as a chart.

    Raises
    ------
    ChartError
        No ColorChecker Classic found, or corners or exposure that do not show one.
    """
    if request.mode == "none" or (request.mode == "auto" and _monochrome(radiance.value[0])):
        return _from_camera(radiance)
    if request.mode == "profile":
        if request.profile is None:
            raise ChartError("a colour profile was asked for and none was given; use --chart FILE")
        return replace(request.profile, source="profile", quads=None, corners=None)
    if request.mode == "corners":
        found = _at_corners(radiance, reference, request.corners, settings)
    elif settings.chart == "sg":
        raise ChartError(
            "a ColorChecker SG is not looked for; give the outer corners of its patches E2, J2, J5, E5 with --chart"
        )
    else:
        found = _search(radiance, reference, settings)
    found, edition = _edition(radiance, found, reference, settings)
    fit = found.seen.fit
    return ColorCalibration(
        matrix=fit.matrix,
        quads=found.place.quads(settings.patch_share),
        corners=found.place.corners(),
        delta_e=fit.delta_e,
        source="corners" if request.mode == "corners" else "chart",
        cost=found.cost,
        metres_per_px=_scale(found.place, radiance.view, settings.chart_width_m),
        falloff=(float(fit.slope[0]), float(fit.slope[1])),
        glare=fit.glare,
        predicted=patches.predicted(found.seen, edition),
        patch_use=found.seen.use,
        edition=edition.name,
        light=chart_light.measure(found.place, radiance.view, fit.slope, found.error),
    )


def _monochrome(value: Floats) -> bool:
    """Whether the three channels are one: without colours there is no chart to look for."""
    step = max(1, int(np.sqrt(value[..., 0].size / 1e5)))
    few = value[::step, ::step]
    return bool(np.array_equal(few[..., 0], few[..., 1]) and np.array_equal(few[..., 0], few[..., 2]))


@dataclass(frozen=True)
class _Find:
    place: Placement
    seen: ChartFit
    cost: float  # the detector's; NaN where the user said where

    @property
    def error(self) -> float:
        return self.seen.mean


def _search(radiance: AngleStack, reference: ChartReference, settings: WhitebalanceSettings) -> _Find:
    """The first candidate that passes every test with ease, else the best; ChartError says what it lacks."""
    value = radiance.value[0]
    known: list[Placement] = []
    best: _Find | None = None
    cheapest, small = np.inf, 0.0
    exposed: ChartError | None = None
    for centers, cost in _candidates(value):
        cheapest = min(cheapest, cost)
        start = chart.from_centers(centers)
        if cost > settings.max_cost or not chart.is_view(start.homography) or _among(known, start):
            continue
        place = _refine(value, start)
        if not _plausible(place, settings.min_explained - _SMALL_PART):
            if place.explained >= settings.min_explained:
                small = max(small, place.pitch_px)
            continue
        known.append(place)
        try:
            seen = patches.sample(value, radiance.quality[0], place, settings.patch_share)
            ways = [  # a detector may read the chart upside down
                _Find(place, patches.fit(seen, reference), cost),
                _Find(place.turned(), patches.fit(seen.turned(), reference), cost),
            ]
        except ChartError as error:
            exposed = error
            continue
        if place.explained < settings.min_explained:
            ways = [way for way in ways if way.error <= settings.max_delta_e / 3]
            if not ways:
                continue
        best = min(ways if best is None else [*ways, best], key=lambda find: find.error)
        if best.error <= settings.max_delta_e / 2:  # beyond, a later picture may place the chart better
            return best
    if best is not None and best.error <= settings.max_delta_e:
        return best
    if exposed is not None:
        raise exposed
    if best is not None:
        why = f"best mean residual ΔE {best.error:.1f}, whitebalance.max_delta_e = {settings.max_delta_e:g}"
    elif 0 < small < _LEAST_PITCH_PX:
        least = _LEAST_PITCH_PX * radiance.view.scale
        why = (
            f"what looks like one has patches {small * radiance.view.scale:.0f} RAW px apart, at least {least:.0f} are "
            "needed: show it larger"
        )
    elif cheapest == np.inf:
        why = "the detector saw nothing like one"
    elif cheapest > settings.max_cost:
        why = f"best detector cost {cheapest:.3f}, limit whitebalance.max_cost = {settings.max_cost:g}"
    else:
        why = f"best candidate (cost {cheapest:.3f}) does not look like 6 × 4 patches on a dark card"
    raise ChartError(f"no ColorChecker Classic in the reference shot, at any scale or exposure ({why}); {_REMEDY}")


def _at_corners(
    radiance: AngleStack, reference: ChartReference, corners_px: Floats | None, settings: WhitebalanceSettings
) -> _Find:
    """The chart where the user says it is, placed more finely where the image allows it."""
    if corners_px is None or np.shape(corners_px) != (4, 2):
        raise ChartError("--chart needs the four outer patch corners x0,y0,…,x3,y3, dark skin first, clockwise")
    height, width = radiance.value.shape[1:3]
    scale = radiance.view.scale
    corners = (np.asarray(corners_px, np.float64) - (scale - 1) / 2) / scale
    placement = chart.from_corners(corners)
    said = "chart corners " + ", ".join(f"({x:g}, {y:g})" for x, y in corners_px)
    if not chart.is_view(placement.homography):
        raise ChartError(f"{said} do not go round clockwise; start at the dark-skin patch, go along its row")
    if (corners < -0.5).any() or (corners > np.array([width, height]) - 0.5).any():
        raise ChartError(f"{said} reach outside the image of {width * scale:g} × {height * scale:g} px; check them")
    if placement.pitch_px < _LEAST_PITCH_PX:
        raise ChartError(
            f"{said} put the patches {placement.pitch_px:.1f} px apart on the merged image, at least "
            f"{_LEAST_PITCH_PX:g} are needed; show the chart larger, or demosaic at full size"
        )
    refined = _refine(radiance.value[0], placement)
    moved = float(np.abs(refined.corners() - corners).max()) / placement.pitch_px
    place = refined if _plausible(refined, settings.min_explained) and moved < 0.35 else placement
    find = _Find(place, _fit(radiance, place, reference, settings), float("nan"))
    if find.error > settings.max_delta_e:
        turned = _Find(place.turned(), _fit(radiance, place.turned(), reference, settings), float("nan"))
        remedy = "check them"
        if turned.error <= settings.max_delta_e:
            remedy = "the chart stands the other way up: start from the corner opposite"
        raise ChartError(
            f"{said} do not show a ColorChecker Classic: mean colour residual ΔE {find.error:.1f}, "
            f"limit whitebalance.max_delta_e = {settings.max_delta_e:g}; {remedy}"
        )
    return find


def _fit(radiance: AngleStack, place: Placement, reference: ChartReference, settings: WhitebalanceSettings) -> ChartFit:
    return patches.fit(patches.sample(radiance.value[0], radiance.quality[0], place, settings.patch_share), reference)


def _edition(
    radiance: AngleStack, found: _Find, reference: ChartReference, settings: WhitebalanceSettings
) -> tuple[_Find, ChartReference]:
    """The find by the edition of the chart that its colors speak for, and that edition."""
    residuals = [patches.residual(found.seen, other) for other in (reference, *reference.editions)]
    least = int(np.argmin(residuals))
    if residuals[least] >= _CLEARLY_BETTER * residuals[0]:
        return found, reference
    edition = reference.editions[least - 1]
    return replace(found, seen=_fit(radiance, found.place, edition, settings)), edition


def _plausible(place: Placement, min_explained: float) -> bool:
    return chart.is_view(place.homography) and place.pitch_px >= _LEAST_PITCH_PX and place.explained >= min_explained


def _among(places: list[Placement], start: Placement) -> bool:
    """Whether a start leads to a place that is known already: all centres within a quarter of a patch."""
    here = chart.project(start.homography, chart.centers())
    return any(
        np.abs(chart.project(way.homography, chart.centers()) - here).max() < 0.25 * place.pitch_px
        for place in places
        for way in (place, place.turned())
    )


def _refine(value: Floats, start: Placement) -> Placement:
    """Place the chart on its surroundings, averaged down where they are large."""
    around = chart.project(start.homography, np.array([[-1.0, -1], [7, -1], [7, 5], [-1, 5]]))
    x0, y0 = np.maximum(np.floor(around.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(around.max(axis=0)).astype(int) + 1, [value.shape[1], value.shape[0]])
    if x1 - x0 < 2 or y1 - y0 < 2:
        return start
    crop, corner = value[y0:y1, x0:x1], np.array([[1.0, 0, -x0], [0, 1, -y0], [0, 0, 1]])
    small = _resized(crop, min(1.0, _WORK_PITCH_PX / start.pitch_px))
    seen = np.clip(small / _white(small), 0.0, 4.0)
    if start.pitch_px < 2 * _NEAR_PITCH_PX:
        return _refined(seen, start, _scaling(seen.shape, crop.shape) @ corner)
    coarse = _resized(seen, _NEAR_PITCH_PX / min(start.pitch_px, _WORK_PITCH_PX))
    near = _refined(coarse, start, _scaling(coarse.shape, crop.shape) @ corner)
    return _refined(seen, near, _scaling(seen.shape, crop.shape) @ corner, _LAST_STEPS)


def _refined(seen: Floats, start: Placement, transform: Floats, steps: int = 12) -> Placement:
    """On a part `seen`, to which `transform` (3, 3) takes the picture's px."""
    return chart.refine(seen, start.moved(transform), steps).moved(np.linalg.inv(transform))


def _candidates(value: Floats) -> Iterator[tuple[Floats, float]]:
    """Patch centres (24, 2) px of whatever the detector takes for a chart, and its cost."""
    small = _resized(value, min(1.0, _QUICK_SIDE / max(value.shape[:2])))
    yield from _detected(_detector(_QUICK), _picture(small, _white(value)), _scaling(small.shape, value.shape))
    detector = _detector({})
    for picture, transform in _pictures(value):
        yield from _detected(detector, picture, transform)


def _detector(parameters: dict[str, float]) -> Any:
    detector, changed = cv2.mcc.CCheckerDetector.create(), cv2.mcc.DetectorParametersMCC()
    for name, value in parameters.items():
        setattr(changed, name, value)
    detector.setColorChartType(cv2.mcc.MCC24)
    detector.setDetectionParams(changed)
    return detector


def _detected(detector: Any, picture: NDArray[np.uint8], transform: Floats) -> Iterator[tuple[Floats, float]]:
    """The same of one picture, to whose px `transform` takes those of the radiance."""
    if detector.process(picture, _CANDIDATES):
        for checker in detector.getListColorChecker():
            quads = np.asarray(checker.getColorCharts(), dtype=np.float64).reshape(24, 4, 2)
            yield chart.project(np.linalg.inv(transform), quads.mean(axis=1)), float(checker.getCost())


def _pictures(value: Floats) -> Iterator[tuple[NDArray[np.uint8], Floats]]:
    """8-bit BGR pictures to search, likeliest first, each with the transform radiance px → picture px.

    Whole frames at several scales and exposures, channels balanced or not; last, for small charts,
    the frame enlarged, or overlapping enlarged tiles of a large frame: the detector shrinks what is large.
    """
    height, width = value.shape[:2]
    longest, white = max(height, width), _white(value)
    alike = np.full(3, white.max())
    looks = {
        1000: [(white, 1.0), (white, 2.5), (white, 0.3), (alike, 1.0), (alike, 2.5), (alike, 0.3)],
        600: [(white, 1.0)],
        1600: [(white, 1.0), (white, 2.5)],
        2400: [(white, 1.0)] if longest <= 2400 else [],
    }
    for side, exposures in looks.items():
        if side > 4.5 * longest:
            continue
        small = _resized(value, side / longest)
        for one, gain in exposures:
            yield _picture(small, one / gain), _scaling(small.shape, value.shape)
    if longest > 2400:
        for y in range(0, max(height - _TILE_PX, 0) + _TILE_STEP_PX, _TILE_STEP_PX):
            for x in range(0, max(width - _TILE_PX, 0) + _TILE_STEP_PX, _TILE_STEP_PX):
                tile = value[y : y + _TILE_PX, x : x + _TILE_PX]
                large = _resized(tile, 1.5)
                transform = _scaling(large.shape, tile.shape) @ np.array([[1.0, 0, -x], [0, 1, -y], [0, 0, 1]])
                yield _picture(large, _white(tile)), transform


def _white(value: Floats) -> Floats:
    """99th percentile of each channel (3,), of every so many pixels."""
    step = max(1, int(np.sqrt(value[..., 0].size / 1e5)))
    return np.maximum(np.percentile(value[::step, ::step], 99, axis=(0, 1)), 1e-9)


def _picture(value: Floats, white: Floats) -> NDArray[np.uint8]:
    level = np.clip(value * np.asarray((len(_GAMMA) - 1) / white, np.float32), 0, len(_GAMMA) - 1)
    return np.ascontiguousarray(_GAMMA[level.astype(np.uint16)][..., ::-1])


def _resized(image: Floats, factor: float) -> Floats:
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    return np.asarray(cv2.resize(np.asarray(image, np.float32), size, interpolation=how))


def _scaling(small: tuple[int, ...], large: tuple[int, ...]) -> Floats:
    """Large px → small px, with pixel centres on whole numbers."""
    x, y = small[1] / large[1], small[0] / large[0]
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])


def _from_camera(radiance: AngleStack) -> ColorCalibration:
    """The camera's own matrix or white balance with sensor white at 1; else colours as they are."""
    matrix = np.eye(3)
    known = radiance.sensor.camera_matrix is not None or radiance.sensor.white_balance is not None
    if radiance.sensor.white_balance is not None:
        matrix = np.diag(np.asarray(radiance.sensor.white_balance, np.float64))
    if radiance.sensor.camera_matrix is not None:
        matrix = np.asarray(radiance.sensor.camera_matrix, np.float64)
    return ColorCalibration(
        matrix=matrix / 2,
        quads=None,
        corners=None,
        delta_e=None,
        source="camera" if known else "none",
        cost=float("nan"),
        metres_per_px=None,
    )


def _scale(place: Placement, view: View, width_m: float | None) -> float | None:
    """Metres per pixel in the plane across the optical axis through the chart's centre: Z/f.

    With K the camera and H the homography from metres along the chart's width, K⁻¹H ∝ (r₁, r₂, t) and
    |r₁| = 1 (Zhang, IEEE PAMI 2000): neither the chart's height nor its tilt is needed.
    """
    if width_m is None:
        return None
    camera = np.array([[view.focal, 0, view.center[0]], [0, view.focal, view.center[1]], [0, 0, 1]])
    middle = np.array([[1.0, 0, chart.COLUMNS / 2], [0, 1, chart.ROWS / 2], [0, 0, 1]])
    pose = np.linalg.solve(camera, place.homography @ middle)
    pitch_m = width_m / (chart.COLUMNS - 1 + place.patch)
    return float(pitch_m * abs(pose[2, 2]) / np.linalg.norm(pose[:, 0]) / view.focal)
