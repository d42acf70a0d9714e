"""The ColorChecker Classic's geometry, and its place in an image to a fraction of a pixel.

Chart coordinates (u, v) count patches: patch (row, column) is centred on (column + ½, row + ½), so the
chart spans 0…6 × 0…4; each patch is a square of side `patch` (its share of the pitch) on a dark card.

The place is found by synthesis: the chart is drawn with its own patch colours through a blurred homography,
and the homography, the patch side and the blur are changed until the drawing fits the image
(Gauss–Newton on every pixel at once, with a robust loss for dust, labels and highlights).

References
----------
Triggs et al., Bundle Adjustment, 2000, §4 (Gauss–Newton); Huber & Ronchetti, Robust Statistics, 2009.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
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
        """Mean distance of neighbouring patches, px."""
        outline = project(self.homography, _outer(1.0))
        return float(np.sqrt(_area(outline) / (ROWS * COLUMNS)))

    def quads(self, share: float = 1.0) -> Floats:
        """(24, 4, 2) corners of each patch, shrunk to `share` of its side; px, from dark skin, row by row."""
        half = share * self.patch / 2
        return project(self.homography, centers()[:, None] + half * _SQUARE)

    def corners(self) -> Floats:
        """(4, 2) outer corners of the outer patches, dark skin first, in the order of reading's clock; px."""
        return project(self.homography, _outer(self.patch))

    def turned(self) -> "Placement":
        """The same rectangle, read upside down."""
        half_turn = np.array([[-1.0, 0, COLUMNS], [0, -1.0, ROWS], [0, 0, 1]])
        return Placement(self.homography @ half_turn, self.patch, self.blur, self.explained)

    def moved(self, transform: Floats) -> "Placement":
        """Seen in another image; transform (3, 3) takes this image's px to the other's."""
        return Placement(transform @ self.homography, self.patch, self.blur, self.explained)


_SQUARE = np.array([[-1.0, -1.0], [1, -1], [1, 1], [-1, 1]])


def centers() -> Floats:
    """(24, 2) patch centres in chart coordinates."""
    v, u = np.mgrid[0:ROWS, 0:COLUMNS] + 0.5
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def from_centers(points: Floats) -> Placement:
    """The placement that brings the patch centres nearest to 24 image points (24, 2) px."""
    return Placement(_homography(centers(), points), USUAL_PATCH, _GREATEST_BLUR / 3, 0.0)


def from_corners(points: Floats, patch: float = USUAL_PATCH) -> Placement:
    """The placement of four outer patch corners (4, 2) px, dark skin first, clockwise on the chart."""
    return Placement(_homography(_outer(patch), points), patch, _GREATEST_BLUR / 3, 0.0)


def project(homography: Floats, points: Floats) -> Floats:
    """Homography (3, 3) of points (..., 2)."""
    image = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(image[..., :2] / image[..., 2:])


def is_view(homography: Floats) -> bool:
    """Whether a flat chart can look like this homography (3, 3): convex, not mirrored, nowhere behind the camera."""
    corners = _outer(1.0)
    depth = corners @ homography[2, :2] + homography[2, 2]
    if not np.isfinite(homography).all() or not (depth * depth[0] > 0).all():
        return False
    corner = project(homography, corners)
    side = np.roll(corner, -1, axis=0) - corner
    after = np.roll(side, -1, axis=0)
    return bool((side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0] > 0).all())


def refine(image: Floats, start: Placement, steps: int = 12) -> Placement:
    """The placement that draws `image` best, from one that is right within a third of a patch.

    Parameters
    ----------
    image
        (H, W, 3) linear, white about 1. Pixels per patch: 8 or more. Light mixes linearly at an edge,
        but the difference is judged through a gamma of 2.2, so that dark patches count.
    start
        The placement to begin with.
    steps
        At most so many.
    """
    frame = _frame(start)  # image px → about the chart's own, so that the steps are well scaled
    at = _pixels(image.shape[:2], start)
    value = image[at[:, 1], at[:, 0]].astype(np.float64)
    if len(value) < 24 * 16:
        return start
    point = project(frame, at.astype(np.float64))
    inverse = np.linalg.inv(frame @ start.homography)
    inverse = inverse / inverse[2, 2]
    least_blur = min(_PIXEL_BLUR_PX / start.pitch_px, _GREATEST_BLUR)
    patch, blur, explained = start.patch, max(start.blur, 0.04), 0.0
    for step in range(steps):
        drawing = _draw(point, value, inverse, patch, blur)
        if drawing is None:
            return start
        residual, jacobian, explained = drawing
        scale = MAD_TO_SIGMA * np.median(np.abs(residual)) + 1e-4
        weight = np.minimum(1.0, 2.5 * scale / (np.abs(residual) + 1e-12))  # Huber
        normal = np.einsum("nci,nc,ncj->ij", jacobian, weight, jacobian)
        right = np.einsum("nci,nc,nc->i", jacobian, weight, residual)
        if not np.trace(normal) > 0:  # even all over: nothing tells
            return start
        damping = 1e-3 * np.diag(normal) + 1e-9 * np.trace(normal)
        change = np.linalg.solve(normal + np.diag(damping), right)
        inverse = inverse + np.append(change[:8], 0.0).reshape(3, 3)
        patch = float(np.clip(patch + change[8], 0.6, 0.97))
        blur = float(np.clip(blur + change[9], least_blur, _GREATEST_BLUR))
        if step > 3 and np.abs(change[:8]).max() < 1e-5:
            break
    homography = np.linalg.inv(frame) @ np.linalg.inv(inverse)
    return Placement(homography / homography[2, 2], patch, blur, explained)


def _draw(
    point: Floats, value: Floats, inverse: Floats, patch: float, blur: float
) -> tuple[Floats, Floats, float] | None:
    """Value − drawing (N, 3) on the chart; the drawing's derivatives (N, 3, 10); variance explained."""
    homogeneous = np.concatenate([point, np.ones((len(point), 1))], axis=1)
    mapped = homogeneous @ inverse.T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = mapped[:, 0] / mapped[:, 2], mapped[:, 1] / mapped[:, 2]
    edge = (1 - patch) / 2 - _MARGIN
    used = (u > edge) & (u < COLUMNS - edge) & (v > edge) & (v < ROWS - edge) & (mapped[:, 2] > 0)
    if used.sum() < 24 * 16:
        return None
    u, v, depth = u[used], v[used], mapped[used, 2]
    homogeneous, value = homogeneous[used], value[used]
    column = np.clip(np.floor(u), 0, COLUMNS - 1).astype(int)
    row = np.clip(np.floor(v), 0, ROWS - 1).astype(int)
    cell = row * COLUMNS + column
    across, across_du, across_patch, across_blur = _box(u - column - 0.5, patch, blur)
    along, along_dv, along_patch, along_blur = _box(v - row - 0.5, patch, blur)
    cover = across * along
    colors, card = _colors(value, cover, cell)
    contrast = (colors - card)[cell]  # (N, 3)
    linear = np.maximum(card + contrast * cover[:, None], _DARKEST)
    drawn = linear ** (1 / _GAMMA)
    contrast = contrast * drawn / linear / _GAMMA
    du, dv = along * across_du, across * along_dv
    turn = homogeneous / depth[:, None]  # ∂u/∂h₁ = x/w, ∂u/∂h₃ = −u x/w
    cover_by = np.concatenate(
        [
            du[:, None] * turn,
            dv[:, None] * turn,
            -(du * u + dv * v)[:, None] * turn[:, :2],
            (across_patch * along + across * along_patch)[:, None],
            (across_blur * along + across * along_blur)[:, None],
        ],
        axis=1,
    )  # (N, 10)
    seen = np.maximum(value, _DARKEST) ** (1 / _GAMMA)
    residual = seen - drawn
    spread = seen - np.median(seen, axis=0)
    explained = 1 - float(np.mean(np.minimum(residual**2, 0.25)) / max(np.mean(spread**2), 1e-9))
    return residual, contrast[:, :, None] * cover_by[:, None, :], explained


def _box(offset: Floats, patch: float, blur: float) -> tuple[Floats, Floats, Floats, Floats]:
    """A blurred box over −patch/2…patch/2, and its derivatives by offset, patch and blur."""
    from scipy.special import ndtr  # here: importing it costs .2 s of every start

    low, high = (offset + patch / 2) / blur, (offset - patch / 2) / blur
    bell_low, bell_high = (np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi) / blur for t in (low, high))
    return (
        ndtr(low) - ndtr(high),
        bell_low - bell_high,
        (bell_low + bell_high) / 2,
        -(bell_low * low - bell_high * high),
    )


def _colors(value: Floats, cover: Floats, cell: NDArray[np.int_]) -> tuple[Floats, Floats]:
    """Colour of each patch (24, 3) and of the card (3,), as the image shows them now."""
    bare = cover < max(0.1, float(np.percentile(cover, 2)))
    card = np.median(value[bare], axis=0)
    colors = np.tile(card, (ROWS * COLUMNS, 1))
    full = cover > 0.9
    for index in range(ROWS * COLUMNS):
        inside = (cell == index) & full
        if inside.any():
            colors[index] = np.median(value[inside], axis=0)
    return colors, card


def _pixels(shape: tuple[int, int], placement: Placement) -> NDArray[np.int_]:
    """(N, 2) pixels x, y on and a little around the chart."""
    outline = project(placement.homography, np.array([[-0.3, -0.3], [6.3, -0.3], [6.3, 4.3], [-0.3, 4.3]]))
    x0, y0 = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 1, [shape[1], shape[0]])
    y, x = np.mgrid[y0 : max(y1, y0), x0 : max(x1, x0)]
    at = np.stack([x.ravel(), y.ravel()], axis=-1)
    side = np.roll(outline, -1, axis=0) - outline
    inside = np.ones(len(at), bool)
    for corner, (dx, dy) in zip(outline, side, strict=True):
        inside &= dx * (at[:, 1] - corner[1]) - dy * (at[:, 0] - corner[0]) >= 0
    return at[inside]


def _frame(placement: Placement) -> Floats:
    """Image px → units of the pitch about the chart's centre, (3, 3)."""
    middle = project(placement.homography, np.array([COLUMNS / 2, ROWS / 2]))
    pitch = placement.pitch_px
    return np.array([[1 / pitch, 0, -middle[0] / pitch], [0, 1 / pitch, -middle[1] / pitch], [0, 0, 1]])


def _outer(patch: float) -> Floats:
    gap = (1 - patch) / 2
    return np.array([[gap, gap], [COLUMNS - gap, gap], [COLUMNS - gap, ROWS - gap], [gap, ROWS - gap]])


def _homography(source: Floats, target: Floats) -> Floats:
    """Direct linear transform of (N ≥ 4, 2) points, on normalised coordinates."""
    frames = []
    for points in (source, target):
        (x, y), unit = points.mean(axis=0), 1 / (points.std() + 1e-12)
        frames.append(np.array([[unit, 0, -x * unit], [0, unit, -y * unit], [0, 0, 1]]))
    (u, v), (x, y) = project(frames[0], source).T, project(frames[1], target).T
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
