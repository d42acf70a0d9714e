"""A ball as its outline shows it: direction and angular radius of the sphere, and its normals.

The view rays that touch a sphere form a cone around the direction of its center, in perspective too: u · c = cos α for
unit rays u, the unit vector c to the center and the angular radius α. So u · w = 1 with w = c / cos α, which is linear.
Wherever the sphere is and however large, its normals follow from c and α.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.errors import ObjectError
from polcap.image_values import Bools, Floats, View
from polcap.optics import frames, outline, robust

LEAST_RADIUS_PX = 24.0  # of a ball on the maps; an error of half a pixel of its outline is one degree at 45°
_TRIALS = 300  # triples of outline points; some have no point of a stand, unless it covers half of the outline
_ROUNDS = 10  # of the biweight
_ON_OUTLINE = 0.02  # radii, and at least 1.5 px: points of the mask's outline that are nearer are the ball's
_LEAST_SHARE = 0.7  # of the outline that must lie on that of a ball
_MOST_MISFIT_PX, _MOST_MISFIT = 0.8, 0.008  # spread of the outline about a ball's, px and radii; an egg has more
_SECOND_BALL = 0.1  # area of the mask's second largest part over that of its largest
_AHEAD = np.array([0.0, 0.0, -1.0])  # direction of the optical axis


@dataclass(frozen=True)
class Ball:
    """A sphere in front of a camera; its size and distance are not known, only their ratio."""

    direction: Floats  # (3,) unit, from the lens to the center, camera frame
    angular_radius: float  # rad

    @property
    def radius(self) -> float:
        """Radius over the distance of the center."""
        return float(np.sin(self.angular_radius))

    def outside(self, view: View, x: Floats, y: Floats) -> Floats:
        """Distance [px] of pixels x, y (...,) from the ball's outline; negative inside."""
        cosine = np.clip(-frames.rays_at(view, x, y) @ self.direction, -1, 1)
        return np.asarray((np.arccos(cosine) - self.angular_radius) * view.focal)

    def points(self, rays: Floats) -> tuple[Floats, Floats]:
        """Surface points (..., 3) that view rays (..., 3), surface to camera, see, and the unit normals (..., 3) there.

        The unit of length is the distance of the ball's center. Rays that miss the ball get the point of its outline
        nearest to them.
        """
        along = -frames.dot(rays, self.direction)
        across = -rays - along[..., None] * self.direction
        sine = np.sqrt(frames.dot(across, across))
        scale = np.minimum(1.0, self.radius / np.maximum(sine, 1e-12))  # a ray that misses is turned to the outline
        inside = self.direction * np.sqrt(np.maximum(1 - (scale * sine) ** 2, 0))[..., None] + across * scale[..., None]
        along = frames.dot(inside, self.direction)
        depth = along - np.sqrt(np.maximum(along**2 - np.cos(self.angular_radius) ** 2, 0))
        point = depth[..., None] * inside
        return point, np.asarray((point - self.direction) / self.radius)

    def normals(self, view: View, shape: tuple[int, int]) -> tuple[Floats, Bools]:
        """Unit normals (H, W, 3) of the ball at each pixel, camera frame, and the pixels (H, W) that show it."""
        rays = frames.rays(view, *shape).astype(np.float64)
        _, normal = self.points(rays)
        return normal, frames.dot(-rays, self.direction) > np.cos(self.angular_radius)

    def radius_px(self, view: View) -> float:
        """Radius on a pixel grid, as if the ball were in the middle of the picture [px]."""
        return view.focal * float(np.tan(self.angular_radius))


@dataclass(frozen=True)
class BallOutline:
    """A ball fitted to the outline of a mask, and the residuals of the fit."""

    ball: Ball
    misfit_px: float  # spread of the mask's outline about that of the ball, 1σ
    share: float  # of the mask's outline that lies on that of the ball; the rest is a stand or a shadow


def fit(mask: Bools, view: View, at_border: bool) -> BallOutline:
    """Fit a ball to the outline of a mask (H, W); parts of the outline that a stand covers do not count.

    `at_border`: the mask touches the edge of the picture.

    Raises ObjectError: the mask shows several balls, a ball that the picture cuts, a small one, or no ball.
    """
    _check_single(mask)
    if at_border:
        raise ObjectError("the ball is cut by the picture's edge; show all of it, with backdrop on every side")
    point = _crossings(mask)
    radius_px = outline.disc_radius(mask)
    if radius_px < LEAST_RADIUS_PX:
        raise ObjectError(
            f"the ball has a radius of {radius_px:.0f} px on the maps, less than {LEAST_RADIUS_PX:g} px; "
            "move closer, or use a longer lens"
        )
    ball = _fit_robustly(-frames.rays_at(view, point[:, 0], point[:, 1]), view.focal)
    distance = ball.outside(view, point[:, 0], point[:, 1])
    on_ball = np.abs(distance) <= max(_ON_OUTLINE * radius_px, 1.5)
    misfit, share = robust.spread(distance[on_ball]) if on_ball.any() else np.inf, float(on_ball.mean())
    limit = max(_MOST_MISFIT_PX, _MOST_MISFIT * radius_px)
    if share < _LEAST_SHARE:
        raise ObjectError(
            f"{100 * share:.0f} % of the object's outline lies on that of a ball, less than {100 * _LEAST_SHARE:.0f} %;"
            " use a ball on a small ring, apart from other objects, or paint its mask (`polcap process --mask`)"
        )
    if misfit > limit:
        raise ObjectError(
            f"the object's outline differs by {misfit:.1f} px from that of a ball, more than {limit:.1f} px; "
            "use a true ball, or paint its mask (`polcap process --mask`)"
        )
    return BallOutline(ball, float(misfit), share)


def _check_single(mask: Bools) -> None:
    """Raise ObjectError if a mask (H, W) holds several objects."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = np.sort(stats[1:, cv2.CC_STAT_AREA])[::-1]
    several = int((area > _SECOND_BALL * area[:1]).sum()) if len(area) else 0
    if several > 1:
        raise ObjectError(
            f"there are {several} objects in the picture; leave one ball in it, or choose one with --set mask.part=1"
        )


def _crossings(mask: Bools) -> Floats:
    """Points x, y (N, 2) [px] halfway between neighboring pixels inside and outside a mask (H, W)."""
    padded = np.pad(mask, 1)
    row, column = np.nonzero(padded[:, 1:] != padded[:, :-1])
    across = np.stack([column - 0.5, row - 1.0], axis=-1)
    row, column = np.nonzero(padded[1:] != padded[:-1])
    return np.concatenate([across, np.stack([column - 1.0, row - 0.5], axis=-1)])


def _fit_robustly(ray: Floats, focal: float) -> Ball:
    """Ball whose outline rays (N, 3), camera to scene, touch: least median of squares, then Tukey's biweight."""
    random = np.random.default_rng(0)
    ball, least_median = _ball(ray, np.ones(len(ray))), np.inf
    for triple in random.integers(len(ray), size=(_TRIALS, 3)):
        if abs(np.linalg.det(ray[triple])) < 1e-12:  # three rays in one plane
            continue
        candidate = _ball(ray[triple], np.ones(3))
        median = float(np.median(np.abs(_angle_beyond(candidate, ray))))
        if median < least_median:
            ball, least_median = candidate, median
    for _ in range(_ROUNDS):
        angle = _angle_beyond(ball, ray)
        ball = _ball(ray, robust.biweight(angle, max(robust.spread(angle), 0.3 / focal)))  # at least 0.3 px
    return ball


def _ball(ray: Floats, weight: Floats) -> Ball:
    """Ball whose outline rays (N, 3) touch, by weighted least squares."""
    w = np.linalg.lstsq(ray * weight[:, None], weight, rcond=None)[0]
    length = float(np.linalg.norm(w))
    if length <= 1:  # no cone: the rays lie in a plane
        return Ball(_AHEAD, 1e-6)
    return Ball(w / length, float(np.arccos(1 / length)))


def _angle_beyond(ball: Ball, ray: Floats) -> Floats:
    """Angle [rad] (N,) of rays beyond a ball's outline."""
    return np.arccos(np.clip(ray @ ball.direction, -1, 1)) - ball.angular_radius
