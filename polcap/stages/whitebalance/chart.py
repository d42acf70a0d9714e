"""Geometry of the ColorChecker Classic, and its subpixel location in an image.

Chart coordinates (u, v) count patches: patch (row, column) is centered on (column + ½, row + ½), so the
chart spans 0…6 × 0…4; each patch is a square of side `patch` (its share of the pitch) on a dark card.

The chart is located by synthesis: it is drawn with its patch colors through a homography, with blurred edges.
Homography, patch side and blur are fitted to all pixels of the image by Gauss–Newton steps, with a robust loss for
dust, labels and highlights.

References
----------
Triggs et al., Bundle Adjustment, 2000, §4 (Gauss–Newton); Huber & Ronchetti, Robust Statistics, 2009.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics.projection import pixels_inside, transform_points
from polcap.optics.robust import spread

ROWS, COLUMNS = 4, 6
USUAL_PATCH = 0.88  # side of a patch / pitch
_LEAST_PATCH, _GREATEST_PATCH = 0.6, 0.97  # limits of the fit
_GREATEST_BLUR = 0.12  # 1σ of edges [pitch]
_START_BLUR = 0.04  # [pitch]
_PIXEL_BLUR_PX = 0.29  # 1/√12, 1σ of a pixel's width: edges cannot be sharper
_GAMMA = 2.2
_DARKEST = 1e-3  # of white; darker values are set to this
_MARGIN = 0.045  # width of card around the outer patches that is compared [pitch]
_AROUND = 0.3  # width around the chart in which pixels are fitted [pitch]
_LEAST_PX = 24 * 16  # pixels of a chart that is fitted
_WORK_PITCH_PX = 32.0  # a chart with more pixels per patch is averaged down before it is fitted
_ITERATIONS = 12  # at most
_STEP = 1e-6  # of the unknowns, for derivatives
_SQUARE = np.array([[-1.0, -1.0], [1, -1], [1, 1], [-1, 1]])  # corners, clockwise in the picture


@dataclass(frozen=True)
class Placement:
    """Location of a ColorChecker in an image: homography, patch side, quality of the fit."""

    homography: Floats  # (3, 3) chart (u, v, 1) → image px (x, y, 1)
    patch: float = USUAL_PATCH  # side of a patch / pitch
    explained: float = 0.0  # share of the image's variance that the drawing explains, ≤ 1

    @property
    def pitch_px(self) -> float:
        """Mean distance of neighboring chart patches, px."""
        area = cv2.contourArea(transform_points(self.homography, _outer(1.0)).astype(np.float32))
        return float(np.sqrt(area / (ROWS * COLUMNS)))

    def quads(self, share: float = 1.0, at: Floats | None = None) -> Floats:
        """Corners (N, 4, 2) px of patches with centers `at` (N, 2), shrunk to `share` of their side.

        By default the 24 patches of the chart, from dark skin, row by row.
        """
        middle = centers() if at is None else at
        return transform_points(self.homography, middle[:, None] + share * self.patch / 2 * _SQUARE)

    def corners(self) -> Floats:
        """Outer corners (4, 2) px of the chart's corner patches, dark skin first, clockwise on the chart."""
        return transform_points(self.homography, _outer(self.patch))

    def turned(self) -> "Placement":
        """Location of the same chart read upside down."""
        return replace(self, homography=self.homography @ [[-1.0, 0, COLUMNS], [0, -1.0, ROWS], [0, 0, 1]])

    def shifted(self, right: int, down: int) -> "Placement":
        """Location of the same number of patches, by whole patches to the right and down on the chart."""
        return replace(self, homography=self.homography @ [[1.0, 0, right], [0, 1.0, down], [0, 0, 1]])

    def moved(self, transform: Floats) -> "Placement":
        """Location of the chart in another image; transform (3, 3) maps px of this image to px of the other."""
        return replace(self, homography=transform @ self.homography)


def centers() -> Floats:
    """Patch centers (24, 2) of a ColorChecker in chart coordinates."""
    v, u = np.mgrid[0:ROWS, 0:COLUMNS] + 0.5
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def from_centers(points: Floats) -> Placement:
    """The placement of a chart with patch centers at image points (24, 2) px, by least squares."""
    return Placement(_homography(centers(), points))


def from_corners(points: Floats, patch: float = USUAL_PATCH) -> Placement:
    """The placement of a chart with outer patch corners (4, 2) px, dark skin first, clockwise on the chart."""
    return Placement(_homography(_outer(patch), points), patch)


def from_sg_corners(points: Floats) -> Placement:
    """The placement of the 24-patch block of a ColorChecker SG, from the outer corners (4, 2) px of A1, N1, N10, A10.

    The block begins at column 5 of 14 and row 2 of 10.
    """
    return Placement(_homography(_outer(USUAL_PATCH, 14, 10) - [4, 1], points))


def is_view(homography: Floats) -> bool:
    """Whether a homography (3, 3) is a possible view of a chart: convex, not mirrored, in front of the camera."""
    corners = _outer(1.0)
    depth = corners @ homography[2, :2] + homography[2, 2]
    if not np.isfinite(homography).all() or not (depth * depth[0] > 0).all():
        return False
    corner = transform_points(homography, corners)
    side = np.roll(corner, -1, axis=0) - corner
    after = np.roll(side, -1, axis=0)
    return bool((side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0] > 0).all())


def refine(picture: Floats, start: Placement) -> Placement:
    """Refine the location of a chart in a linear picture (H, W, 3); `start` may err by a third of a patch.

    A chart with more than 32 pixels per patch is averaged down first.
    """
    around = transform_points(start.homography, np.array([[-1.0, -1], [7, -1], [7, 5], [-1, 5]]))
    x0, y0 = np.maximum(np.floor(around.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(around.max(axis=0)).astype(int) + 1, picture.shape[1::-1])
    if x1 - x0 < 2 or y1 - y0 < 2:
        return start
    crop = picture[y0:y1, x0:x1]
    seen = resize(crop, min(1.0, _WORK_PITCH_PX / start.pitch_px))
    to_seen = scaling(seen.shape, crop.shape) @ np.array([[1.0, 0, -x0], [0, 1, -y0], [0, 0, 1]])
    return _fit(np.clip(seen / white(seen), 0, 4), start.moved(to_seen)).moved(np.linalg.inv(to_seen))


def white(picture: Floats) -> Floats:
    """White level of a picture (H, W, 3): 99th percentile of each channel (3,), from about 10⁵ pixels."""
    step = max(1, int(np.sqrt(picture[..., 0].size / 1e5)))
    return np.maximum(np.percentile(picture[::step, ::step], 99, axis=(0, 1)), 1e-9)


def resize(picture: Floats, factor: float) -> Floats:
    """Resize a picture (H, W, 3) by a factor: by area means below 1, by cubic interpolation above."""
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    size = (max(1, round(picture.shape[1] * factor)), max(1, round(picture.shape[0] * factor)))
    return np.asarray(cv2.resize(np.asarray(picture, np.float32), size, interpolation=method))


def scaling(small: tuple[int, ...], large: tuple[int, ...]) -> Floats:
    """Transform (3, 3) from px of a large picture to px of its reduced copy, with pixel centers at integers."""
    x, y = small[1] / large[1], small[0] / large[0]
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])


def _fit(image: Floats, start: Placement) -> Placement:
    """Fit a drawing of the chart (homography, patch side, blur) to an image (H, W, 3) with white about 1.

    Light mixes linearly at an edge; residuals are computed after a gamma of 2.2, so that dark patches count too.
    """
    middle, pitch = transform_points(start.homography, np.array([COLUMNS / 2, ROWS / 2])), start.pitch_px
    to_pitches = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, pitch]]) / pitch  # px → units of the pitch
    rectangle = np.array([COLUMNS, ROWS]) / 2 * (1 + _SQUARE) + _AROUND * _SQUARE
    at = pixels_inside(transform_points(start.homography, rectangle), image.shape)
    value = np.maximum(image[at[:, 1], at[:, 0]], _DARKEST)  # (N, 3)
    point = to_pitches @ np.column_stack([at, np.ones(len(at))]).T
    inverse = np.linalg.inv(to_pitches @ start.homography)
    unknowns = np.array([*(inverse / inverse[2, 2]).ravel()[:8], start.patch, _START_BLUR])
    low = [*[-np.inf] * 8, _LEAST_PATCH, min(_PIXEL_BLUR_PX / pitch, _GREATEST_BLUR)]
    high = [*[np.inf] * 8, _GREATEST_PATCH, _GREATEST_BLUR]
    explained = 0.0
    for iteration in range(_ITERATIONS):
        cover, cell, used = _cover(point, unknowns)
        if used.sum() < _LEAST_PX:
            return start
        cover, cell, seen = cover[used], cell[used], value[used]
        colors, card = _colors(seen, cover, cell)
        contrast = colors[cell] - card
        linear = np.maximum(contrast * cover[:, None] + card, _DARKEST)
        drawn = linear ** (1 / _GAMMA)
        by_cover = contrast * drawn / linear / _GAMMA  # derivative of the drawn value by the cover
        seen = seen ** (1 / _GAMMA)
        residual = seen - drawn
        jacobian = [(_cover(point[:, used], unknowns + h)[0] - cover) / _STEP for h in _STEP * np.eye(10)]
        weight = np.minimum(1, 2.5 * spread(residual) / (np.abs(residual) + 1e-12)) * by_cover  # Huber
        normal = np.asarray(jacobian) * (weight * by_cover).sum(axis=1) @ np.transpose(jacobian)
        if not np.trace(normal) > 0:  # a uniform picture
            return start
        damping = 1e-3 * np.diag(normal) + 1e-9 * np.trace(normal)
        change = np.linalg.solve(normal + np.diag(damping), jacobian @ (weight * residual).sum(axis=1))
        unknowns = np.clip(unknowns + change, low, high)
        variance = float(np.mean((seen - np.median(seen, axis=0)) ** 2))
        explained = 1 - float(np.mean(np.minimum(residual**2, 0.25))) / max(variance, 1e-9)
        if iteration > 3 and np.abs(change[:8]).max() < 1e-5:
            break
    homography = np.linalg.inv(np.append(unknowns[:8], 1.0).reshape(3, 3) @ to_pitches)
    return Placement(homography / homography[2, 2], float(unknowns[8]), explained)


def _cover(point: Floats, unknowns: Floats) -> tuple[Floats, NDArray[np.intp], Bools]:
    """Share of each pixel that a chart's patch covers, the index of the patch, and whether the pixel is on the chart.

    point (3, N) are homogeneous coordinates; the ten unknowns are a homography to chart coordinates without its last
    number, the side of a patch, and the blur.
    """
    from scipy.special import ndtr  # here: the import takes 0.2 s

    patch, blur = unknowns[8:]
    projected = np.append(unknowns[:8], 1.0).reshape(3, 3) @ point
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = projected[:2] / projected[2]
    margin, last = (1 - patch) / 2 - _MARGIN, np.array([[COLUMNS], [ROWS]])
    on_chart = ((uv > margin) & (uv < last - margin)).all(axis=0) & (projected[2] > 0)
    index = np.clip(np.nan_to_num(np.floor(uv)), 0, last - 1)
    from_center = uv - index - 0.5
    sides = ndtr((from_center + patch / 2) / blur) - ndtr((from_center - patch / 2) / blur)
    return sides[0] * sides[1], (index[1] * COLUMNS + index[0]).astype(np.intp), on_chart


def _colors(value: Floats, cover: Floats, cell: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Color of each chart patch (24, 3) and of the card (3,): medians of the pixels (N, 3) that it fills."""
    card = np.median(value[cover < max(0.1, float(np.percentile(cover, 2)))], axis=0)
    full = [value[(cell == index) & (cover > 0.9)] for index in range(ROWS * COLUMNS)]
    return np.array([np.median(inside, axis=0) if len(inside) else card for inside in full]), card


def _outer(patch: float, columns: int = COLUMNS, rows: int = ROWS) -> Floats:
    """Outer corners (4, 2) of a chart's corner patches in chart coordinates, the first patch first, clockwise."""
    gap = (1 - patch) / 2
    return np.array([[gap, gap], [columns - gap, gap], [columns - gap, rows - gap], [gap, rows - gap]])


def _homography(source: Floats, target: Floats) -> Floats:
    """Homography (3, 3) from points (N ≥ 4, 2) to points (N, 2); NaN if there is none."""
    found = cv2.findHomography(source, np.asarray(target, np.float64))[0]
    return np.full((3, 3), np.nan) if found is None else np.asarray(found)
