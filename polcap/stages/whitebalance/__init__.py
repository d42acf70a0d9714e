"""Stage 2: color calibration, the matrix from camera channels to Rec.709, by a ColorChecker in the reference shot.

The chart is searched in 8-bit gamma pictures of the merged radiance (`chart_search`), and located to a fraction of a
pixel in the radiance itself (`chart`). Its patches are sampled in the linear radiance (`patches`). A candidate is
accepted only if detector, drawn model and colors all agree with a ColorChecker Classic. `color_matrix` solves for the
color matrix.

References
----------
McCamy, Marcus, Davidson, A Color-Rendition Chart, J. Applied Photographic Engineering 1976.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from polcap.chart_values import ChartPlace, ChartReference, ChartRequest, ColorCalibration, PatchColors
from polcap.errors import ChartError
from polcap.image_values import Floats, View
from polcap.optics.projection import to_grid
from polcap.stage_values import AngleStack
from polcap.stages import stage
from polcap.stages.whitebalance import chart, chart_light, chart_search, patches
from polcap.stages.whitebalance.chart import Placement
from polcap.stages.whitebalance.patches import ChartFit, PatchSamples

_LEAST_PITCH_PX = 8.0  # with less, a patch has too few pixels
_CLEARLY_BETTER = 0.5  # residual with another edition of the chart over that with the stated one: 15 charts had ≥ 0.93
_EDGES = 0.05  # a candidate with fitting colors may explain this much less: edges cover much of small patches
_MOST_MOVED = 0.35  # largest refinement of corners from the user [pitch]
_REMEDY = "give its corners with --chart x0,y0,…,x3,y3, a profile with --chart FILE, or --no-chart"


class WhitebalanceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `whitebalance`, the section `whitebalance` of a settings file."""

    chart: Annotated[
        str,
        Meta(
            pattern=r"^(classic|classic_before_2014|classic_srgb|sg)$|[./\\]",
            description="classic, classic_before_2014, classic_srgb, sg, or a file of measured colors (CSV or CGATS); "
            "classic: the edition since 2014 unless another fits its colors much better; sg: a (Digital) SG; its "
            "corners by --chart may be those of the whole chart, or of its block E2 to J5",
        ),
    ] = "classic"
    chart_width_m: (
        Annotated[float, Meta(gt=0, le=2, description="width between outer patch corners; unset: unknown [m]")] | None
    ) = None
    max_cost: Annotated[float, Meta(gt=0, le=1, description="greatest accepted cost of the chart detector")] = 0.06
    max_delta_e: Annotated[
        float, Meta(gt=0, le=100, description="greatest accepted mean residual of the patches [CIEDE2000]")
    ] = 15.0
    min_explained: Annotated[
        float, Meta(ge=0, le=1, description="least share of the chart's variance that 24 flat patches explain")
    ] = 0.9
    patch_share: Annotated[float, Meta(ge=0.2, le=0.95, description="sampled share of each patch's side")] = 0.6


@stage(version=11)
def measure(
    radiance: AngleStack, reference: ChartReference, request: ChartRequest, settings: WhitebalanceSettings
) -> ColorCalibration:
    """The color matrix of a capture, on the scale of S0 = I₀ + I₉₀, with the chart's place and residuals.

    Patches of the reference shot, the first of (K, H, W, 3), give S0 = 2·I, because a matt chart that faces the camera
    is unpolarized. At the white patch matrix @ S0 = reflectance + glare. `light` describes how much less light this
    patch receives than a surface that faces the flash; `cues` corrects for it. `delta_e` is NaN for patches that were
    left out. `metres_per_px` needs `settings.chart_width_m`: the chart's size is not assumed.

    Raises ChartError: no ColorChecker is found, or it is not visible at the corners from the user, or it is
    over-exposed.
    """
    monochrome = (radiance.value[0] == radiance.value[0, ..., :1]).all()
    if request.mode == "none" or (request.mode == "auto" and monochrome):
        return _from_camera(radiance)
    if request.mode == "profile":
        if request.profile is None:
            raise ChartError("a color profile is needed; name its file with --chart FILE")
        return replace(request.profile, source="profile", place=None)
    finder = _ChartFinder(radiance, reference, settings)
    found = finder.at_corners(request.corners) if request.mode == "corners" else finder.search()
    edition = finder.edition(found)
    seen = found.colors if edition is reference else replace(finder, reference=edition).find(found.place).colors
    fit, predicted = seen.fit, patches.cross_validate(seen, edition)
    if edition.surroundings is not None:
        around = finder.sample(found.place, edition.surroundings.center)
        fit, predicted = patches.fit_with_surroundings(seen, around, edition)
    return ColorCalibration(
        matrix=fit.matrix,
        source="corners" if request.mode == "corners" else "chart",
        cost=found.cost,
        metres_per_px=_scale(found.place, radiance.view, settings.chart_width_m),
        place=ChartPlace(found.place.quads(settings.patch_share), found.place.corners()),
        light=chart_light.measure(found.place, radiance.view, fit.slope, seen.error),
        patches=PatchColors(
            delta_e=fit.delta_e[: len(seen.use)],
            use=seen.use,
            predicted=predicted,
            falloff=(float(fit.slope[0]), float(fit.slope[1])),
            glare=fit.glare,
            edition=edition.name,
            surroundings=None if edition.surroundings is None else fit.delta_e[len(seen.use) :],
        ),
    )


@dataclass(frozen=True)
class _LocatedChart:
    """A located chart with its fitted colors."""

    place: Placement
    colors: ChartFit
    cost: float = float("nan")  # the detector's; NaN at corners from the user


@dataclass(frozen=True)
class _ChartFinder:
    """Locates a chart in the reference shot, and judges its place by the fit of its colors."""

    radiance: AngleStack
    reference: ChartReference
    settings: WhitebalanceSettings

    def search(self) -> _LocatedChart:
        """Search the chart: the best candidate up to the first with half the accepted residual. Raises ChartError."""
        settings, picture = self.settings, self.radiance.value[0]
        found: list[_LocatedChart] = []
        least_cost, largest_px = np.inf, 0.0
        overexposed: ChartError | None = None
        for centers, cost in chart_search.candidates(picture, self.reference.is_block):
            least_cost = min(least_cost, cost)
            start = chart.from_centers(centers)
            if cost > settings.max_cost or not chart.is_view(start.homography):
                continue
            place = chart.refine(picture, start)
            well_explained = place.explained >= settings.min_explained
            if not _plausible(place, settings.min_explained - _EDGES):
                largest_px = max(largest_px, place.pitch_px) if well_explained else largest_px
                continue
            try:
                one = self._oriented(place, cost)
            except ChartError as error:
                overexposed = error
                continue
            if well_explained or one.colors.error <= settings.max_delta_e / 3:
                found.append(one)
            if any(one.colors.error <= settings.max_delta_e / 2 for one in found):  # else a later one may be better
                break
        best = min(found, key=lambda one: one.colors.error, default=None)
        if best is not None and best.colors.error <= settings.max_delta_e:
            return best
        if overexposed is not None:
            raise overexposed
        scale = self.radiance.view.scale
        if best is not None:
            why = f"best mean residual ΔE {best.colors.error:.1f}, whitebalance.max_delta_e = {settings.max_delta_e:g}"
        elif 0 < largest_px < _LEAST_PITCH_PX:
            why = (
                f"its patches are spaced by {largest_px * scale:.0f} RAW px, at least {_LEAST_PITCH_PX * scale:.0f} "
                "are needed: show it larger"
            )
        elif least_cost == np.inf:
            why = "the detector found nothing like it"
        elif least_cost > settings.max_cost:
            why = f"best detector cost {least_cost:.3f}, limit whitebalance.max_cost = {settings.max_cost:g}"
        else:
            why = f"the best candidate (cost {least_cost:.3f}) does not show 6 × 4 patches on a dark card"
        name = "ColorChecker SG" if self.reference.is_block else "ColorChecker Classic"
        raise ChartError(f"no {name} in the reference shot, at any scale or exposure ({why}); {_REMEDY}", why)

    def _oriented(self, place: Placement, cost: float) -> _LocatedChart:
        """The chart at a place, in the orientation of the better colors; of an SG its block. Raises ChartError."""
        ways = [place, place.turned()]  # the detector may see it upside down
        if self.reference.is_block:
            block = chart.refine(self.radiance.value[0], self._sg_block(place))
            ways = [block if _plausible(block, self.settings.min_explained) else place]
        return replace(self._best((way, self.sample(way)) for way in ways), cost=cost)

    def _sg_block(self, place: Placement) -> Placement:
        """Find the block of a ColorChecker SG: of the 6 × 4 patches around a place those with the best colors.

        Any 6 × 4 patches of an SG (14 × 10) look like its block to the detector, and may be upside down. The block
        begins at column 5 and row 2, so it is at most 4 columns and 5 rows away. Raises ChartError.
        """
        column, row = (grid.ravel() for grid in np.meshgrid(np.arange(-4, 10), np.arange(-5, 9)))
        around = self.sample(place, np.stack([column, row], axis=-1) + 0.5)
        ways = []
        for right, down in itertools.product(range(-4, 5), range(-5, 6)):
            inside = (column >= right) & (column < right + chart.COLUMNS) & (row >= down) & (row < down + chart.ROWS)
            block, samples = place.shifted(right, down), around.select(inside)
            if down < 2:  # upright: the block starts in row 2 of ten
                ways.append((block, samples))
            if down > -2:  # upside down
                ways.append((block.turned(), samples.turned()))
        return self._best(ways).place

    def _best(self, ways: Iterable[tuple[Placement, PatchSamples]]) -> _LocatedChart:
        """The chart with the smallest color residual of some `ways` to place it. Raises ChartError: too few patches."""
        finds, failed = list[_LocatedChart](), ChartError("")
        for place, samples in ways:
            try:
                finds.append(_LocatedChart(place, patches.fit(samples, self.reference)))
            except ChartError as error:
                failed = error
        if not finds:
            raise failed
        return min(finds, key=lambda find: find.colors.error)

    def at_corners(self, corners_px: Floats | None) -> _LocatedChart:
        """Locate the chart at corners (4, 2) RAW px from the user, refined in the picture where that is plausible.

        Raises ChartError: there are not four corners; they are not clockwise, outside the picture, or too close
        together; or the colors between them are not those of a chart.
        """
        if corners_px is None or np.shape(corners_px) != (4, 2):
            raise ChartError(
                "--chart needs the four outer corners of the patches x0,y0,…,x3,y3, clockwise from dark skin"
            )
        height, width = self.radiance.value.shape[1:3]
        scale = self.radiance.view.scale
        corners = to_grid(np.asarray(corners_px, np.float64), scale)
        start = chart.from_corners(corners)
        if self.reference.surroundings is not None:  # the corners may be those of the whole SG, or of its block
            start = min(start, chart.from_sg_corners(corners), key=self._error)
        stated = "chart corners " + ", ".join(f"({x:g}, {y:g})" for x, y in corners_px)
        if not chart.is_view(start.homography):
            raise ChartError(f"{stated} are not clockwise; start at the dark-skin patch and go along its row")
        if (corners < -0.5).any() or (corners > np.array([width, height]) - 0.5).any():
            raise ChartError(
                f"{stated} are outside the picture of {width * scale:g} × {height * scale:g} px; check them"
            )
        if start.pitch_px < _LEAST_PITCH_PX:
            raise ChartError(
                f"{stated} space the patches by {start.pitch_px:.1f} px on the merged image, at least "
                f"{_LEAST_PITCH_PX:g} are needed; show the chart larger, or demosaic at full size"
            )
        refined = chart.refine(self.radiance.value[0], start)
        moved = float(np.abs(refined.corners() - start.corners()).max()) / start.pitch_px
        find = self.find(refined if _plausible(refined, self.settings.min_explained) and moved < _MOST_MOVED else start)
        if find.colors.error > self.settings.max_delta_e:
            upside_down = self.find(find.place.turned()).colors.error <= self.settings.max_delta_e
            remedy = "the chart is upside down: start from the opposite corner" if upside_down else "check them"
            raise ChartError(
                f"{stated} do not show a ColorChecker Classic: mean color residual ΔE {find.colors.error:.1f}, "
                f"limit whitebalance.max_delta_e = {self.settings.max_delta_e:g}; {remedy}"
            )
        return find

    def find(self, place: Placement) -> _LocatedChart:
        """Sample and fit the chart's colors at a place. Raises ChartError: too few patches are usable."""
        return _LocatedChart(place, patches.fit(self.sample(place), self.reference))

    def _error(self, place: Placement) -> float:
        """Color residual of the chart at a place; infinite if too few patches are usable."""
        try:
            return self.find(place).colors.error
        except ChartError:
            return np.inf

    def sample(self, place: Placement, at: Floats | None = None) -> PatchSamples:
        """Sample the patches of the chart, or those with centers `at` (N, 2) in chart coordinates."""
        return patches.sample(self.radiance.value[0], self.radiance.quality[0], place, self.settings.patch_share, at)

    def edition(self, found: _LocatedChart) -> ChartReference:
        """Choose the edition of the chart (by year of manufacture) with the colors that fit best."""
        editions = (self.reference, *self.reference.editions)
        residuals = [patches.residual(found.colors, edition) for edition in editions]
        least = int(np.argmin(residuals))
        return editions[least] if residuals[least] < _CLEARLY_BETTER * residuals[0] else self.reference


def _plausible(place: Placement, min_explained: float) -> bool:
    """Whether a place is a possible view of a chart, with large patches that explain enough of the variance."""
    return chart.is_view(place.homography) and place.pitch_px >= _LEAST_PITCH_PX and place.explained >= min_explained


def _from_camera(radiance: AngleStack) -> ColorCalibration:
    """Color calibration by the camera's matrix or white balance, else the identity; halved, as S0 is twice a shot."""
    sensor = radiance.sensor
    if sensor.camera_matrix is not None:
        return ColorCalibration(np.asarray(sensor.camera_matrix, np.float64) / 2, "camera")
    if sensor.white_balance is not None:
        return ColorCalibration(np.diag(np.asarray(sensor.white_balance, np.float64)) / 2, "camera")
    return ColorCalibration(np.eye(3) / 2, "none")


def _scale(place: Placement, view: View, width_m: float | None) -> float | None:
    """Metres per pixel (Z/f) in the plane through the chart's center, perpendicular to the axis.

    With K the camera and H the homography from metres along the chart's width, K⁻¹H ∝ (r₁, r₂, t) with
    |r₁| = 1 (Zhang, IEEE PAMI 2000). So neither the chart's height nor its tilt is needed.
    """
    if width_m is None:
        return None
    middle = np.array([[1.0, 0, chart.COLUMNS / 2], [0, 1, chart.ROWS / 2], [0, 0, 1]])
    pose = np.linalg.solve(view.intrinsic, place.homography @ middle)
    pitch_m = width_m / (chart.COLUMNS - 1 + place.patch)
    return float(pitch_m * abs(pose[2, 2]) / np.linalg.norm(pose[:, 0]) / view.focal)
