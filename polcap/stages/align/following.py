"""How one shot is laid over another: detail at several scales, and Gauss–Newton steps towards the likest.

References
----------
Benhimane & Malis, Homography-based 2D visual tracking and servoing, IJRR 2007 (second-order steps).
Huber & Ronchetti, Robust Statistics, 2009 (biweight and scale).
"""

from functools import cached_property

import cv2
import numpy as np

from polcap.images import Floats, MaskedImage, Quality
from polcap.optics.robust import BIWEIGHT, MAD_TO_SIGMA
from polcap.optics.warp import Spline, Taps, coordinates, warp

_ALIASING_PX2 = 0.05**2  # variance of an edge's place between two samplings of it
_FLOOR_PX = 0.02  # error that aliasing leaves whatever the noise: the bundled capture's is .026 and .025 (decision 19)
_MOST_POINTS = 2e4  # of a picture tell of a movement; more, evenly thinned, tell no more (decision 19)
_MEDIAN_OF = 5000  # points: knows a median to 2 %
_SETTLED_PX, _NEAR_PX = 0.004, 0.03  # a step that moves no corner by more is the last; at coarse scales
_SIDE = 1024
LEAST_PIXELS = 30  # that show detail, for two to eight unknowns


def fine(shot: MaskedImage, detail_px: float, step: int) -> "Scale":
    """Fine structure of one shot's log radiance and its weight.

    Parameters
    ----------
    shot
        (H, W, 3).
    detail_px
        Structure coarser than this Gaussian sigma is taken out [px of the averaged grid].
    step
        So many pixels a side are averaged first.
    """
    total = averaged(_summed(shot.value), step)
    sigma = np.sqrt(_summed(_thinned(shot.variance, total.shape, step))) / step
    some = (slice(None, None, 5),) * 2  # enough for a percentile
    # The floor keeps the logarithm of a dark background from amplifying its noise.
    floor = max(float(np.percentile(total[some], 99)) * 0.01, 2 * float(np.median(sigma[some])), 1e-9)
    level = np.maximum(total, 0)
    level += np.float32(floor)
    log = cv2.log(level)
    smooth = cv2.GaussianBlur(log, (0, 0), 0.7)  # both shots need one resolution; cubic warps change it
    reach = 2 * int(np.ceil(3 * detail_px)) + 1
    smooth -= cv2.GaussianBlur(log, (reach, reach), detail_px)
    sigma /= level
    sigma *= sigma
    sigma += np.float32(0.003**2)
    weight = np.divide(np.float32(1), sigma, out=sigma)
    clipped = shot.quality & np.uint8(Quality.CLIPPED)
    if clipped.any():
        clipped = (averaged(clipped.astype(np.float32), step) > 0).astype(np.uint8)
        reach = int(np.ceil(2 * detail_px)) | 1
        weight[cv2.dilate(clipped, np.ones((reach, reach), np.uint8)) > 0] = 0
    return Scale(smooth, weight)


class Detail:
    """One shot's detail at all scales, each made when it is asked for."""

    def __init__(self, whole: "Scale") -> None:
        self._scales: dict[int, Scale] = {1: whole}

    def edges(self) -> "Detail":
        """Where edges are and how strong, whichever side is brighter: the root of their strength, about its mean."""
        whole = self._scales[1]
        strength = np.sqrt(cv2.GaussianBlur(np.hypot(*whole.gradient), (0, 0), 1.0))
        return Detail(Scale(np.asarray(strength - strength.mean()), whole.weight))

    def __getitem__(self, shrink: int) -> "Scale":
        """The same of an image averaged down."""
        if shrink not in self._scales:
            whole = self._scales[1]
            self._scales[shrink] = Scale(averaged(whole.value, shrink), averaged(whole.weight, shrink))
        return self._scales[shrink]


class Scale:
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
    def tells(self) -> bool:
        """Whether it shows anything that could be compared."""
        seen = self.value[self.weight > 0]
        return len(seen) > LEAST_PIXELS and bool(np.ptp(seen) > 0)

    @cached_property
    def spline(self) -> Spline:
        return Spline(self.value)


def _summed(picture: Floats) -> Floats:
    """Over channels, (H, W)."""
    return np.asarray(cv2.transform(np.asarray(picture, np.float32), np.ones((1, 3), np.float32)))


def _thinned(picture: Floats, shape: tuple[int, ...], step: int) -> Floats:
    """One pixel of each step × step block of (H, W, C): of a variance, which changes slowly."""
    if step == 1:
        return picture
    height, width = shape
    return np.asarray(
        cv2.resize(picture[: height * step, : width * step], (width, height), interpolation=cv2.INTER_NEAREST)
    )


def averaged(image: Floats, step: int) -> Floats:
    """Means of step × step blocks of (H, W); an incomplete last block is dropped."""
    if step == 1:
        return image
    height, width = image.shape[0] // step, image.shape[1] // step
    whole = image[: height * step, : width * step]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def to_full_grid(transform: Floats, step: float) -> Floats:
    """A transform (3, 3) of a grid averaged by `step` on the grid it was averaged from (1/step: the other way)."""
    up = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1.0]])
    return np.asarray(up @ transform @ np.linalg.inv(up))


def refine(reference: Detail, shot: Detail, start: Floats, model: str) -> tuple[Floats, float]:
    """Coarse-to-fine robust Gauss–Newton; the transform (3, 3) and its 1σ at the weighted pixels, px.

    Parameters
    ----------
    reference
        Where a pixel's weight is 0 it does not count.
    shot
        To be laid over it.
    start
        (3, 3) reference px → shot px, to begin with.
    model
        How it may have moved: translation, similarity or homography.
    """
    transform = start
    for shrink in (4, 2, 1):
        level = to_full_grid(transform, 1 / shrink)
        coarse = "translation" if shrink == 4 and model != "translation" else model
        compared = _Compared(reference[shrink], shot[shrink], level, coarse, near=shrink > 1)
        settled = _SETTLED_PX if shrink == 1 else _NEAR_PX
        for _ in range(15):
            step, moved = compared.step(level)
            level = level @ step
            level = level / level[2, 2]
            if moved < settled:
                break
        transform = to_full_grid(level, shrink)
    return transform, float(np.hypot(compared.sigma(), _FLOOR_PX))


def sigma_at(reference: Detail, shot: Detail, transform: Floats, point: Floats) -> float:
    """1σ of where a similarity puts a point, px; far from what told, open roll and zoom count with the distance.

    Parameters
    ----------
    reference
        Where a pixel's weight is 0 it does not count.
    shot
        What was laid over it.
    transform
        (3, 3) reference px → shot px, as refined.
    point
        x, y, 1 on the reference.
    """
    compared = _Compared(reference[1], shot[1], transform, "similarity")
    if len(compared.x) <= LEAST_PIXELS:
        return np.inf
    x, y = (point[0] - compared.width / 2) / compared.size, (point[1] - compared.height / 2) / compared.size
    lever = np.array([[1, 0, x, -y], [0, 1, y, x]])
    compared.step(transform)
    covariance = lever @ compared.covariance() @ lever.T
    return float(np.hypot(np.sqrt(max(np.trace(covariance) / 2, 0.0)), _FLOOR_PX))


class _Compared:
    """The pixels of two shots that tell how one moved against the other."""

    def __init__(self, a: Scale, b: Scale, level: Floats, model: str, near: bool = False) -> None:
        """Two shots under a first guess `level` (3, 3) of a model; `near` is enough for a coarse scale."""
        self.shot, self.model, self.coarse = b, model, near
        self.height, self.width = a.value.shape
        self.size = max(self.height, self.width) / 2
        other = warp(b.weight, level, order=1)
        weight = a.weight * other / (a.weight + other + np.float32(1e-12))  # of a difference
        gx, gy = a.gradient
        information = weight * (gx * gx + gy * gy)  # what a pixel says of the movement; most say nothing
        use = (weight > 1e-9) & (information > 0.05 * information.mean())
        use[:4] = use[-4:] = False
        use[:, :4] = use[:, -4:] = False
        at = np.flatnonzero(use)
        at = at[:: max(1, round(len(at) / _MOST_POINTS))]
        self.y, self.x = np.divmod(at, self.width)
        self.unit = tuple(
            ((c - side / 2) / self.size).astype(np.float32) for c, side in ((self.x, self.width), (self.y, self.height))
        )
        self.value, self.weight = a.value.ravel()[at], weight.ravel()[at]
        self.gradient = gx.ravel()[at], gy.ravel()[at]
        self.beyond: tuple[Floats, Floats] | None = None  # the shot's gradient, from where the first step began
        self.last: tuple[Floats, Floats, Floats] | None = None  # the last step's JᵀWJ, WJ and what was left

    def step(self, transform: Floats) -> tuple[Floats, float]:
        """One compositional update (3, 3) that brings b∘transform closer to a, and how far it moves a corner, px."""
        if len(self.x) <= LEAST_PIXELS:
            return np.eye(3), 0.0
        difference, jacobian = self._linearized(transform)
        # An edge sampled at two phases differs by a share of its own gradient: aliasing counts as noise,
        # else the robust loss keeps the edges that happen to agree and pulls the shift to whole pixels.
        slope = jacobian[0] ** 2 + jacobian[1] ** 2
        w = 1 / (np.float32(_ALIASING_PX2) * slope + 1 / self.weight)
        normalized = np.abs(difference) * np.sqrt(w)
        scale = MAD_TO_SIGMA * _weighted_median(normalized, w * slope) + 1e-9
        normalized *= np.float32(1 / (BIWEIGHT * scale))
        w *= np.square(np.maximum(0, 1 - normalized * normalized))
        weighted = jacobian * w
        normal = (weighted @ jacobian.T).astype(np.float64) + 1e-12 * np.eye(len(jacobian))
        self.last = normal, weighted, difference
        p = np.linalg.solve(normal, (weighted @ difference).astype(np.float64))
        step = _matrix(p, self.width, self.height, self.size)
        return step, float(np.abs(step - np.eye(3))[:2].dot([self.width / 2, self.height / 2, 1]).max())

    def covariance(self) -> Floats:
        """Of the last step's parameters (P, P), about the image centre in units of `size`."""
        if self.last is None:
            return np.full((2, 2), np.inf)
        normal, weighted, difference = self.last
        # Neighbouring residuals are correlated by the blur over about ten pixels.
        residual = (weighted * difference).astype(np.float64)
        inverse = np.linalg.inv(normal)
        return np.asarray(10 * inverse @ (residual @ residual.T) @ inverse)

    def sigma(self) -> float:
        """1σ of the last step's shift, px."""
        covariance = self.covariance()
        return float(np.sqrt(max(float(np.trace(covariance[:2, :2])), 0.0) / 2))  # below 0: rounding

    def _linearized(self, transform: Floats) -> tuple[Floats, Floats]:
        """a − b∘transform at the pixels (N,), and its derivative by the update's parameters (P, N); float32."""
        count = len(self.x)
        u, v = (_rows(c) for c in coordinates(transform, self.x, self.y))
        if self.coarse:
            warped = _between(self.shot.value, u, v).ravel()[:count]
        else:
            warped = self.shot.spline.at(Taps(u, v, (self.height, self.width))).ravel()[:count]
        if self.beyond is None:
            bx, by = (_between(g, u, v).ravel()[:count] for g in self.shot.gradient)
            self.beyond = bx, by
        bx, by = self.beyond
        m = transform.astype(
            np.float32
        )  # the warped shot's gradient: of a homography this near a similarity, its linear part's
        gx = (self.gradient[0] + m[0, 0] * bx + m[1, 0] * by) / 2
        gy = (self.gradient[1] + m[0, 1] * bx + m[1, 1] * by) / 2
        x, y = self.unit
        columns = [gx, gy]
        if self.model in ("similarity", "homography"):
            columns += [gx * x + gy * y, gy * x - gx * y]
        if self.model == "homography":
            radial = gx * x + gy * y
            columns += [gx * x - gy * y, gx * y + gy * x, radial * x, radial * y]
        return self.value - warped, np.stack(columns)


def _between(picture: Floats, x: Floats, y: Floats) -> Floats:
    """Linearly interpolated at places of any shape."""
    at = x.astype(np.float32), y.astype(np.float32)
    return np.asarray(cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


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


def likeness(reference: Detail, shot: Detail, transform: Floats) -> float:
    """Weighted zero-mean correlation of the detail of two shots once registered by (3, 3); of every fourth pixel."""
    some, there = (slice(None, None, 2),) * 2, transform @ np.diag([2.0, 2.0, 1.0])
    a, b = reference[1], shot[1]
    value = np.ascontiguousarray(a.value[some])
    height, width = value.shape
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(b.value, there, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    weight = a.weight[some] * warp(b.weight, there, (0, 0, width, height), order=1)
    weighted = weight * warped
    product = float(np.vdot(weighted, value))
    power = float(np.vdot(weight * value, value)) * float(np.vdot(weighted, warped))
    return float(product / np.sqrt(power + 1e-30))
