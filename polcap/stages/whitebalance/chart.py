"""The ColorChecker Classic's geometry, and its place in an image to a fraction of a pixel.

Chart coordinates (u, v) count patches: patch (row, column) is centered on (column + ½, row + ½), so the
chart spans 0…6 × 0…4; each patch is a square of side `patch` (its share of the pitch) on a dark card.

The place is found by synthesis: the chart is drawn with its own patch colors through a blurred homography,
and the homography, the patch side and the blur are changed until the drawing fits the image
(Gauss–Newton on every pixel at once, with a robust loss for dust, labels and highlights).

References
----------
Triggs et al., Bundle Adjustment, 2000, §4 (Gauss–Newton); Huber & Ronchetti, Robust Statistics, 2009.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics.projection import transform_points
from polcap.optics.robust import MAD_TO_SIGMA

ROWS, COLUMNS = 4, 6
USUAL_PATCH = 0.88  # side of a patch / pitch
_GREATEST_BLUR = 0.12  # 1σ of the edges [pitch]
_PIXEL_BLUR_PX = 0.29  # 1σ of a pixel's own width, 1/√12: no edge is sharper
_GAMMA = 2.2
_DARKEST = 1e-3  # of white; darker counts as this
_MARGIN = 0.045  # how far beyond the outer patches the card is compared [pitch]


@dataclass(frozen=True)
class Placement:
    """A chart in an image."""

    homography: Floats  # (3, 3) chart (u, v, 1) → image px (x, y, 1)
    patch: float  # side of a patch / pitch
    blur: float  # 1σ of its edges / pitch
    explained: float  # share of the variance that the drawing accounts for, ≤ 1

    @property
    def pitch_px(self) -> float:
        """Mean distance of neighboring patches, px."""
        outline = transform_points(self.homography, _outer(1.0))
        return float(np.sqrt(_area(outline) / (ROWS * COLUMNS)))

    def quads(self, share: float = 1.0) -> Floats:
        """(24, 4, 2) corners of each patch, shrunk to `share` of its side; px, from dark skin, row by row."""
        half = share * self.patch / 2
        return transform_points(self.homography, centers()[:, None] + half * _SQUARE)

    def corners(self) -> Floats:
        """(4, 2) outer corners of the outer patches, dark skin first, clockwise on the chart; px."""
        return transform_points(self.homography, _outer(self.patch))

    def turned(self) -> "Placement":
        """The same place, read upside down."""
        half_turn = np.array([[-1.0, 0, COLUMNS], [0, -1.0, ROWS], [0, 0, 1]])
        return Placement(self.homography @ half_turn, self.patch, self.blur, self.explained)

    def moved(self, transform: Floats) -> "Placement":
        """The place in another image; transform (3, 3) takes this image's px to the other's."""
        return Placement(transform @ self.homography, self.patch, self.blur, self.explained)


_SQUARE = np.array([[-1.0, -1.0], [1, -1], [1, 1], [-1, 1]])
_AROUND = np.array([[-0.3, -0.3], [6.3, -0.3], [6.3, 4.3], [-0.3, 4.3]])  # the compared part, in chart coordinates


def centers() -> Floats:
    """(24, 2) patch centers in chart coordinates."""
    v, u = np.mgrid[0:ROWS, 0:COLUMNS] + 0.5
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def from_centers(points: Floats) -> Placement:
    """The placement that brings the patch centers nearest to 24 image points (24, 2) px."""
    return Placement(_homography(centers(), points), USUAL_PATCH, _GREATEST_BLUR / 3, 0.0)


def from_corners(points: Floats, patch: float = USUAL_PATCH) -> Placement:
    """The placement of four outer patch corners (4, 2) px, dark skin first, clockwise on the chart."""
    return Placement(_homography(_outer(patch), points), patch, _GREATEST_BLUR / 3, 0.0)


def is_view(homography: Floats) -> bool:
    """Whether a flat chart can look like this homography (3, 3): convex, not mirrored, nowhere behind the camera."""
    corners = _outer(1.0)
    depth = corners @ homography[2, :2] + homography[2, 2]
    if not np.isfinite(homography).all() or not (depth * depth[0] > 0).all():
        return False
    corner = transform_points(homography, corners)
    side = np.roll(corner, -1, axis=0) - corner
    after = np.roll(side, -1, axis=0)
    return bool((side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0] > 0).all())


def refine(image: Floats, start: Placement, steps: int = 12) -> Placement:
    """The placement whose drawing fits the image best, in `steps` at most from one that is right to a third of a patch.

    The image (H, W, 3) is linear, with white about 1 and 8 pixels per patch or more. Light mixes linearly at an edge,
    but the difference is judged through a gamma of 2.2, so that dark patches count.
    """
    frame = _frame(start)  # image px → about the chart's own, so that all unknowns have one scale
    at = pixels_inside(transform_points(start.homography, _AROUND), image.shape)
    value = np.ascontiguousarray(image[at[:, 1], at[:, 0]].T, np.float32)
    if value.shape[1] < 24 * 16:
        return start
    point = transform_points(frame, at.astype(np.float64)).T
    inverse = np.linalg.inv(frame @ start.homography)
    inverse = inverse / inverse[2, 2]
    least_blur = min(_PIXEL_BLUR_PX / start.pitch_px, _GREATEST_BLUR)
    patch, blur, drawing = start.patch, max(start.blur, 0.04), None
    seen = _encoded(np.maximum(value, np.float32(_DARKEST)))
    for step in range(steps):
        drawing = _draw(point, value, seen, inverse, patch, blur)
        if drawing is None:
            return start
        normal, right = drawing.equations()
        if not np.trace(normal) > 0:  # an even picture
            return start
        damping = 1e-3 * np.diag(normal) + 1e-9 * np.trace(normal)
        change = np.linalg.solve(normal + np.diag(damping), right)
        inverse = inverse + np.append(change[:8], 0.0).reshape(3, 3)
        patch = float(np.clip(patch + change[8], 0.6, 0.97))
        blur = float(np.clip(blur + change[9], least_blur, _GREATEST_BLUR))
        if step > 3 and np.abs(change[:8]).max() < 1e-5:
            break
    homography = np.linalg.inv(frame) @ np.linalg.inv(inverse)
    explained = 0.0 if drawing is None else drawing.explained()
    return Placement(homography / homography[2, 2], patch, blur, explained)


@dataclass(frozen=True)
class _Drawing:
    """A chart drawn over N pixels, float32: the residual and its derivatives by the ten unknowns."""

    seen: Floats  # (3, N) encoded
    residual: Floats  # (3, N) seen − drawn
    contrast: Floats  # (3, N) derivative of the drawing by cover
    cover_by: Floats  # (10, N) derivative of cover by the homography's eight numbers, patch and blur

    def equations(self) -> tuple[Floats, Floats]:
        """JᵀWJ (10, 10) and JᵀWr (10,) with Huber weights W; a pixel's J is contrast times cover_by."""
        off = np.abs(self.residual)
        scale = np.float32(MAD_TO_SIGMA * np.median(off) + 1e-4)
        weight = np.minimum(np.float32(1), np.float32(2.5) * scale / (off + np.float32(1e-12)))
        weight *= self.contrast
        slope = np.sum(weight * self.contrast, axis=0)
        pull = np.sum(weight * self.residual, axis=0)
        return ((self.cover_by * slope) @ self.cover_by.T).astype(np.float64), (self.cover_by @ pull).astype(np.float64)

    def explained(self) -> float:
        """Share of the variance that the drawing accounts for."""
        spread = self.seen - np.median(self.seen, axis=1)[:, None]
        return 1 - float(np.mean(np.minimum(self.residual**2, 0.25)) / max(float(np.mean(spread**2)), 1e-9))


def _encoded(linear: Floats) -> Floats:
    return np.asarray(np.exp(np.log(linear) * np.float32(1 / _GAMMA)))


def _draw(point: Floats, value: Floats, seen: Floats, inverse: Floats, patch: float, blur: float) -> _Drawing | None:
    """The chart over points (2, N) of its frame that show `value` (3, N), encoded `seen`; None if it lies outside."""
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, depth = inverse[:, :2] @ point + inverse[:, 2:]
        u, v = u / depth, v / depth
    edge = (1 - patch) / 2 - _MARGIN
    used = (u > edge) & (u < COLUMNS - edge) & (v > edge) & (v < ROWS - edge) & (depth > 0)
    if used.sum() < 24 * 16:
        return None
    u, v, x, y, over = (a[used].astype(np.float32) for a in (u, v, *point, 1 / depth))
    value, seen = value[:, used], seen[:, used]
    column, row = np.clip(np.floor(u), 0, COLUMNS - 1), np.clip(np.floor(v), 0, ROWS - 1)
    cell = (row * COLUMNS + column).astype(np.intp)
    half = np.float32(0.5)
    across, across_du, across_patch, across_blur = _box(u - column - half, patch, blur)
    along, along_dv, along_patch, along_blur = _box(v - row - half, patch, blur)
    cover = across * along
    colors, card = _colors(value, cover, cell)
    contrast = np.take((colors - card).T.astype(np.float32), cell, axis=1)
    linear = np.maximum(contrast * cover + card.astype(np.float32)[:, None], np.float32(_DARKEST))
    drawn = _encoded(linear)
    contrast *= drawn
    contrast /= linear
    contrast *= np.float32(1 / _GAMMA)
    du, dv = along * across_du * over, across * along_dv * over  # ∂u/∂h₁ = x/w, ∂u/∂h₃ = −u x/w
    both = -(du * u + dv * v)
    cover_by = np.stack(
        [
            *(du * x, du * y, du),
            *(dv * x, dv * y, dv),
            *(both * x, both * y),
            across_patch * along + across * along_patch,
            across_blur * along + across * along_blur,
        ]
    )
    return _Drawing(seen, seen - drawn, contrast, cover_by)


def _box(offset: Floats, patch: float, blur: float) -> tuple[Floats, Floats, Floats, Floats]:
    """A blurred box over −patch/2…patch/2, and its derivatives by offset, patch and blur; float32."""
    from scipy.special import ndtr  # here: importing it costs .2 s of every start

    over = np.float32(1 / blur)
    low, high = (offset + np.float32(patch / 2)) * over, (offset - np.float32(patch / 2)) * over
    peak = over / np.float32(np.sqrt(2 * np.pi))
    bell_low, bell_high = (peak * np.exp(np.float32(-0.5) * t * t) for t in (low, high))
    return (
        ndtr(low) - ndtr(high),
        bell_low - bell_high,
        (bell_low + bell_high) / 2,
        bell_high * high - bell_low * low,
    )


def _colors(value: Floats, cover: Floats, cell: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Color of each patch (24, 3) and of the card (3,), medians of pixels (3, N)."""
    bare = cover < max(0.1, float(np.percentile(cover, 2)))
    card = np.median(value[:, bare], axis=1)
    colors = np.tile(card, (ROWS * COLUMNS, 1))
    full = np.flatnonzero(cover > 0.9)
    full = full[np.argsort(cell[full], kind="stable")]
    ends = np.searchsorted(cell[full], np.arange(ROWS * COLUMNS + 1))
    inside = value[:, full]
    for index, (start, end) in enumerate(pairwise(ends)):
        if end > start:
            colors[index] = _medians(inside[:, start:end])
    return colors, card


def _medians(value: Floats) -> Floats:
    """Medians of rows (C, N), faster than np.median on so few values."""
    low, high = (value.shape[1] - 1) // 2, value.shape[1] // 2
    ordered = np.partition(value, (low, high), axis=1)
    return np.asarray((ordered[:, low] + ordered[:, high]) / 2)


def pixels_inside(quad: Floats, shape: tuple[int, ...]) -> NDArray[np.int_]:
    """(N, 2) x, y of the pixels of a picture (H, W, …) in a convex quad (4, 2) px, clockwise."""
    x0, y0 = np.maximum(np.floor(quad.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(quad.max(axis=0)).astype(int) + 1, [shape[1], shape[0]])
    y, x = np.mgrid[y0 : max(y1, y0), x0 : max(x1, x0)]
    inside = np.ones(x.shape, bool)
    for (ax, ay), (bx, by) in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0
    return np.stack([x[inside], y[inside]], axis=-1)


def _frame(placement: Placement) -> Floats:
    """Image px → units of the pitch about the chart's center, (3, 3)."""
    middle = transform_points(placement.homography, np.array([COLUMNS / 2, ROWS / 2]))
    pitch = placement.pitch_px
    return np.array([[1 / pitch, 0, -middle[0] / pitch], [0, 1 / pitch, -middle[1] / pitch], [0, 0, 1]])


def _outer(patch: float) -> Floats:
    gap = (1 - patch) / 2
    return np.array([[gap, gap], [COLUMNS - gap, gap], [COLUMNS - gap, ROWS - gap], [gap, ROWS - gap]])


def _homography(source: Floats, target: Floats) -> Floats:
    """Direct linear transform of (N ≥ 4, 2) points, on normalized coordinates."""
    frames = []
    for points in (source, target):
        (x, y), unit = points.mean(axis=0), 1 / (points.std() + 1e-12)
        frames.append(np.array([[unit, 0, -x * unit], [0, unit, -y * unit], [0, 0, 1]]))
    (u, v), (x, y) = transform_points(frames[0], source).T, transform_points(frames[1], target).T
    one, zero = np.ones_like(u), np.zeros_like(u)
    rows = np.concatenate(
        [
            np.stack([u, v, one, zero, zero, zero, -x * u, -x * v, -x], axis=-1),
            np.stack([zero, zero, zero, u, v, one, -y * u, -y * v, -y], axis=-1),
        ]
    )
    h = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    h = np.linalg.inv(frames[1]) @ h @ frames[0]
    return np.asarray(h / h[2, 2])


def _area(polygon: Floats) -> float:
    x, y = polygon.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
