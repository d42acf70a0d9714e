"""Stage 3: find where each polarizer shot sees what the reference shot sees.

Turning the polarizer changes brightness smoothly over the object, a nudge of the camera moves its
texture. So the shots are compared in the logarithm of radiance with everything coarser than a few
pixels taken out: what remains is texture, chart and outline, which polarization hardly touches, and
a robust loss drops the pixels where it does. The transform is refined by Gauss–Newton steps with the
mean of both images' gradients, coarse to fine.

References
----------
Benhimane & Malis, Homography-based 2D visual tracking and servoing, IJRR 2007 (second-order steps).
Huber & Ronchetti, Robust Statistics, 2009 (biweight and scale).
"""

from functools import cached_property
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import AlignmentError
from polcap.images import Alignment, AngleStack, ColorCalibration, Floats, Quality
from polcap.optics.robust import BIWEIGHT, MAD_TO_SIGMA
from polcap.optics.warp import Spline, Taps, coordinates, warp
from polcap.stages import stage

_ALIASING_PX2 = 0.05**2  # variance of an edge's place between two samplings of it
_FLOOR_PX = 0.02  # error that aliasing leaves whatever the noise: the bundled capture's is .016 and .027 (decision 19)
_MOST_POINTS = 1e5  # of a picture tell of a movement; more, evenly thinned, tell no more (decision 19)
_MEDIAN_OF = 20000  # points: knows a median to 1 %
_SIDE = 1024
_SURE_LIKENESS = 0.6  # correlation of detail from which no other start is tried; else the likest wins
_LEAST_PIXELS = 30  # that show detail, for two to eight unknowns
_MOST_PIXELS = 1.5e6  # a larger image is averaged down first: it has detail to spare


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `align` of a settings file."""

    model: Annotated[
        Literal["none", "translation", "similarity", "homography"],
        Meta(description="how a shot may have moved; none: trust a locked camera"),
    ] = "similarity"
    max_shift_px: Annotated[
        float, Meta(ge=0.5, le=500, description="greatest accepted movement of any shot [grid px]")
    ] = 40.0
    min_correlation: Annotated[
        float, Meta(ge=0, le=1, description="least correlation of detail after registration")
    ] = 0.5
    detail_px: Annotated[
        float,
        Meta(ge=1, le=50, description="structure coarser than this Gaussian sigma is ignored [grid px]"),
    ] = 4.0


@stage(version=4)
def register(radiance: AngleStack, color: ColorCalibration, settings: Settings) -> Alignment:
    """One transform per shot, reference grid px → shot grid px.

    Parameters
    ----------
    radiance
        The shots (K, H, W, 3).
    color
        Tells where the chart lies.
    settings
        How a shot may have moved, and how far.

    Raises
    ------
    AlignmentError
        A shot moved too far, or shows another scene; names it.
    """
    shots = len(radiance.angle)
    if radiance.offset_px is not None:
        return _as_known(radiance.offset_px)
    step = int(np.ceil(np.sqrt(radiance.value[0, ..., 0].size / _MOST_PIXELS)))
    detail = [_Detail(_fine(radiance, k, settings.detail_px, step)) for k in range(shots)]
    transform = np.tile(np.eye(3), (shots, 1, 1))
    residual = np.zeros(shots)
    correlation = np.ones(shots)
    height, width = radiance.value.shape[1:3]
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], float).T
    for k in range(1, shots):
        if settings.model == "none":
            continue
        name = f"shot {np.degrees(radiance.angle[k]):g}°"
        if not _in_common(detail[0][1], detail[k][1]):
            raise AlignmentError(
                f"{name} has no unclipped detail in common with the first shot: over-exposed, black, or even all over; "
                "shoot a darker frame, or with a locked camera --set align.model=none"
            )
        transform[k], residual[k], correlation[k] = _find(detail[0], detail[k], settings.model)
        transform[k] = _to_full_grid(transform[k], step)
        residual[k] *= step
        moved = transform[k] @ corners
        shift = np.abs(moved[:2] / moved[2] - corners[:2]).max()
        if not np.isfinite(shift) or correlation[k] < settings.min_correlation:
            raise AlignmentError(
                f"{name} shows another scene than the first shot: correlation {correlation[k]:.2f}, "
                f"less than align.min_correlation = {settings.min_correlation:g}; "
                "check its files, or reshoot with the camera and the object held still"
            )
        if shift > settings.max_shift_px:
            raise AlignmentError(
                f"{name} moved by {shift:.1f} px, more than align.max_shift_px = {settings.max_shift_px:g}; "
                "reshoot, or raise it"
            )
    return Alignment(transform=transform, residual_px=residual, correlation=correlation)


def _as_known(offset_px: Floats) -> Alignment:
    """Shots cut from one mosaic stand where its pixels stand."""
    transform = np.tile(np.eye(3), (len(offset_px), 1, 1))
    transform[:, :2, 2] = -offset_px
    return Alignment(transform, np.zeros(len(offset_px)), np.ones(len(offset_px)))


def _fine(radiance: AngleStack, k: int, detail_px: float, step: int) -> "_Scale":
    """Fine structure of one shot's log radiance and its weight."""
    total = _averaged(_summed(radiance.value[k]), step)
    sigma = np.sqrt(_averaged(_summed(radiance.variance[k]), step)) / step
    some = (slice(None, None, 3),) * 2  # enough for a percentile
    # The floor keeps the logarithm of a dark background from amplifying its noise.
    floor = max(float(np.percentile(total[some], 99)) * 0.01, 2 * float(np.median(sigma[some])), 1e-9)
    level = np.maximum(total, 0)
    level += np.float32(floor)
    log = np.log(level)
    smooth = cv2.GaussianBlur(log, (0, 0), 0.7)  # both shots need one resolution; cubic warps change it
    smooth -= cv2.GaussianBlur(log, (0, 0), detail_px)
    sigma /= level
    sigma *= sigma
    sigma += np.float32(0.003**2)
    weight = np.divide(np.float32(1), sigma, out=sigma)
    clipped = (radiance.quality[k] & Quality.CLIPPED).astype(np.uint8)
    if clipped.any():
        clipped = (_averaged(clipped.astype(np.float32), step) > 0).astype(np.uint8)
        reach = int(np.ceil(2 * detail_px)) | 1
        weight[cv2.dilate(clipped, np.ones((reach, reach), np.uint8)) > 0] = 0
    return _Scale(smooth, weight)


class _Detail:
    """One shot's detail at all scales, each made when it is asked for."""

    def __init__(self, whole: "_Scale") -> None:
        self._scales: dict[int, _Scale] = {1: whole}

    def edges(self) -> "_Detail":
        """Where edges are and how strong, whichever side is brighter: the root of their strength, about its mean."""
        whole = self._scales[1]
        strength = np.sqrt(cv2.GaussianBlur(np.hypot(*whole.gradient), (0, 0), 1.0))
        return _Detail(_Scale(np.asarray(strength - strength.mean()), whole.weight))

    def __getitem__(self, shrink: int) -> "_Scale":
        """The same of an image averaged down."""
        if shrink not in self._scales:
            whole = self._scales[1]
            self._scales[shrink] = _Scale(_averaged(whole.value, shrink), _averaged(whole.weight, shrink))
        return self._scales[shrink]


class _Scale:
    """One shot's detail at one scale."""

    def __init__(self, value: Floats, weight: Floats) -> None:
        self.value = value  # (H, W)
        self.weight = weight  # (H, W) 1/variance, 0 where clipped

    @cached_property
    def gradient(self) -> tuple[Floats, Floats]:
        """Central differences, (H, W) each."""
        x, y = (
            cv2.Sobel(self.value, cv2.CV_32F, x, 1 - x, ksize=1, scale=0.5, borderType=cv2.BORDER_REPLICATE)
            for x in (1, 0)
        )
        return np.asarray(x), np.asarray(y)

    @cached_property
    def spline(self) -> Spline:
        return Spline(self.value)


def _summed(picture: Floats) -> Floats:
    """Over channels, (H, W)."""
    return np.asarray(cv2.transform(np.asarray(picture, np.float32), np.ones((1, 3), np.float32)))


def _averaged(image: Floats, step: int) -> Floats:
    """Means of step × step blocks; an incomplete last block is dropped."""
    if step == 1:
        return image
    height, width = image.shape[0] // step, image.shape[1] // step
    whole = image[: height * step, : width * step]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def _to_full_grid(transform: Floats, step: float) -> Floats:
    """A transform of a grid averaged by `step` on the grid it was averaged from (1/step: the other way)."""
    up = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1.0]])
    return np.asarray(up @ transform @ np.linalg.inv(up))


def _in_common(reference: _Scale, shot: _Scale) -> bool:
    """Whether both show anything that could be compared."""
    return all(
        np.count_nonzero(one.weight) > _LEAST_PIXELS and np.ptp(one.value[one.weight > 0]) > 0
        for one in (reference, shot)
    )


def _find(reference: _Detail, shot: _Detail, model: str) -> tuple[Floats, float, float]:
    """Transform of a shot, its 1σ in px, and the likeness of the two shots under it.

    Polarization may change which side of an edge is bright: where the detail is little alike, the edges are compared
    in its place, and from where a camera stands that was not touched.
    """
    found = _follow(reference, shot, _coarse_shift(reference, shot), model)
    if found[2] > _SURE_LIKENESS:
        return found
    edges, still = (reference.edges(), shot.edges()), np.zeros(2)
    others = [
        _follow(reference, shot, still, model),
        _follow(*edges, _coarse_shift(*edges), model),
        _follow(*edges, still, model),
    ]
    return max(found, *others, key=lambda one: one[2])


def _follow(reference: _Detail, shot: _Detail, shift: Floats, model: str) -> tuple[Floats, float, float]:
    """The same from a first shift (2,) px."""
    start = np.eye(3)
    start[:2, 2] = shift
    transform, residual = _refine(reference, shot, start, model)
    return transform, residual, _correlation(reference, shot, transform)


def _coarse_shift(reference: _Detail, shot: _Detail) -> Floats:
    """Whole-image translation by phase correlation at half size, (2,) px."""
    a, b = reference[2], shot[2]
    window = cv2.createHanningWindow(a.value.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(a.value * np.sqrt(a.weight), b.value * np.sqrt(b.weight), window)
    return 2 * np.array(shift)


def _refine(reference: _Detail, shot: _Detail, start: Floats, model: str) -> tuple[Floats, float]:
    """Coarse-to-fine robust Gauss–Newton; the transform and its 1σ at the weighted pixels, px."""
    transform = start
    error = np.inf
    for shrink in (4, 2, 1):
        height, width = reference[shrink].value.shape
        level = _to_full_grid(transform, 1 / shrink)
        coarse = "translation" if shrink == 4 and model != "translation" else model
        compared = _Compared(reference[shrink], shot[shrink], level, coarse)
        for _ in range(15):
            step, error = compared.step(level)
            level = level @ step
            level = level / level[2, 2]
            if np.abs(step - np.eye(3))[:2].dot([width / 2, height / 2, 1]).max() < 0.004:
                break
        transform = _to_full_grid(level, shrink)
    return transform, float(np.hypot(error, _FLOOR_PX))


class _Compared:
    """The pixels of two shots that tell how one moved against the other."""

    def __init__(self, a: _Scale, b: _Scale, level: Floats, model: str) -> None:
        self.shot, self.model = b, model
        self.height, self.width = a.value.shape
        self.size = max(self.height, self.width) / 2
        other = warp(b.weight, level, order=1)
        weight = 1 / (1 / np.maximum(a.weight, 1e-12) + 1 / np.maximum(other, 1e-12))
        gx, gy = a.gradient
        information = weight * (gx * gx + gy * gy)  # what a pixel says of the movement; most say nothing
        use = (weight > 1e-9) & (information > 0.05 * information.mean())
        use[:4] = use[-4:] = False
        use[:, :4] = use[:, -4:] = False
        at = np.flatnonzero(use)
        at = at[:: max(1, round(len(at) / _MOST_POINTS))]
        self.y, self.x = np.divmod(at, self.width)
        self.value, self.weight = a.value.ravel()[at], weight.ravel()[at].astype(np.float64)
        self.gradient = gx.ravel()[at], gy.ravel()[at]

    def step(self, transform: Floats) -> tuple[Floats, float]:
        """One compositional update (3, 3) that brings b∘transform closer to a, and its 1σ, px."""
        count = len(self.x)
        if count <= _LEAST_PIXELS:
            return np.eye(3), np.inf
        u, v = (_rows(c) for c in coordinates(transform, self.x, self.y))
        warped = self.shot.spline.at(Taps(u, v, (self.height, self.width))).ravel()[:count]
        u, v = u.astype(np.float32), v.astype(np.float32)
        bx, by = (
            cv2.remap(g, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()[:count]
            for g in self.shot.gradient
        )
        m = transform  # the warped shot's gradient: of a homography this near a similarity, its linear part's
        gx = (self.gradient[0] + m[0, 0] * bx + m[1, 0] * by) / 2
        gy = (self.gradient[1] + m[0, 1] * bx + m[1, 1] * by) / 2
        x, y = (self.x - self.width / 2) / self.size, (self.y - self.height / 2) / self.size
        columns = [gx, gy]
        if self.model in ("similarity", "homography"):
            columns += [gx * x + gy * y, gy * x - gx * y]
        if self.model == "homography":
            radial = gx * x + gy * y
            columns += [gx * x - gy * y, gx * y + gy * x, radial * x, radial * y]
        jacobian = np.stack(columns).astype(np.float64)
        difference = (self.value - warped).astype(np.float64)
        # An edge sampled at two phases differs by a share of its own gradient: aliasing counts as noise,
        # else the robust loss keeps the edges that happen to agree and pulls the shift to whole pixels.
        slope = jacobian[0] ** 2 + jacobian[1] ** 2
        w = 1 / (_ALIASING_PX2 * slope + 1 / self.weight)
        normalized = np.abs(difference) * np.sqrt(w)
        scale = MAD_TO_SIGMA * _weighted_median(normalized, w * slope) + 1e-9
        w = w * np.maximum(0, 1 - (normalized / (BIWEIGHT * scale)) ** 2) ** 2
        weighted = jacobian * w
        normal = weighted @ jacobian.T + 1e-12 * np.eye(len(jacobian))
        p = np.linalg.solve(normal, weighted @ difference)
        # Neighbouring residuals are correlated by the blur over about ten pixels.
        residual = weighted * difference
        spread = np.linalg.inv(normal) @ (residual @ residual.T) @ np.linalg.inv(normal)
        error = float(np.sqrt(10 * np.trace(spread[:2, :2]) / 2))
        return _matrix(p, self.width, self.height, self.size), error


def _rows(points: Floats) -> Floats:
    """(N,) as a picture, filled up with zeros: OpenCV's pictures have sides under 32768 px."""
    out = np.zeros((len(points) // _SIDE + 1, _SIDE))
    out.ravel()[: len(points)] = points
    return out


def _matrix(p: Floats, width: int, height: int, size: float) -> Floats:
    """The update's parameters (about the image centre, in units of `size`) as a px transform."""
    dx, dy, zoom, turn, *rest = [*p, 0.0, 0.0][: max(len(p), 4)]
    stretch, shear, tilt_x, tilt_y = [*rest, 0.0, 0.0, 0.0, 0.0][:4]
    local = np.array(
        [
            [1 + (zoom + stretch) / size, (shear - turn) / size, dx / size],
            [(turn + shear) / size, 1 + (zoom - stretch) / size, dy / size],
            [-tilt_x / size, -tilt_y / size, 1],
        ]
    )
    to_unit = np.array([[1 / size, 0, -width / 2 / size], [0, 1 / size, -height / 2 / size], [0, 0, 1]])
    return np.asarray(np.linalg.inv(to_unit) @ local @ to_unit)


def _weighted_median(value: Floats, weight: Floats) -> float:
    step = max(1, len(value) // _MEDIAN_OF)
    value, weight = value[::step], weight[::step]
    order = np.argsort(value)
    total = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(total, total[-1] / 2)])


def _correlation(reference: _Detail, shot: _Detail, transform: Floats) -> float:
    """Weighted zero-mean correlation of the detail of two shots once registered."""
    a, b = reference[1], shot[1]
    height, width = a.value.shape
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(b.value, transform, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    weight = a.weight * warp(b.weight, transform, order=1)
    weighted = weight * warped
    product = float(np.vdot(weighted, a.value))
    power = float(np.vdot(weight * a.value, a.value)) * float(np.vdot(weighted, warped))
    return float(product / np.sqrt(power + 1e-30))
