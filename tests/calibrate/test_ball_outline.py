"""The outline of a ball gives its true normals; an object that is no ball is one clear line."""

import cv2
import numpy as np
import pytest

from polcap.calibrate import ball_outline
from polcap.errors import ObjectError
from polcap.image_values import Bools, Floats, View
from polcap.optics import frames

VIEW = View(focal=900.0, center=(-60.0, 110.0), scale=2.0)  # the ball is far from the optical axis
SHAPE = (260, 300)
CENTER, RADIUS = np.array([0.2, -0.03, -1.0]), 0.11


def sphere(center: Floats, radius: float) -> tuple[Floats, Bools]:
    """Normals (H, W, 3) and mask of a sphere: |t d − c|² = r² for the ray d of each pixel, solved for t."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    ray = np.stack([(x - VIEW.center[0]) / VIEW.focal, (VIEW.center[1] - y) / VIEW.focal, -np.ones(SHAPE)], axis=-1)
    a, b, c = (ray * ray).sum(-1), ray @ center, center @ center - radius**2
    seen = b * b - a * c > 0
    t = (b - np.sqrt(np.maximum(b * b - a * c, 0))) / a
    return (t[..., None] * ray - center) / radius, seen


def test_a_mask_gives_place_size_and_normals_in_perspective() -> None:
    normal, mask = sphere(CENTER, RADIUS)
    found = ball_outline.fit(mask, VIEW, at_border=False)
    distance = float(np.linalg.norm(CENTER))
    assert VIEW.focal * np.abs(found.ball.direction - CENTER / distance).max() < 0.05  # px
    assert found.ball.radius == pytest.approx(RADIUS / distance, abs=0.05 / VIEW.focal)
    truth, shown = found.ball.normals(VIEW, SHAPE)
    assert np.median(frames.angle_deg(truth, normal)[mask & shown]) < 0.05
    assert found.misfit_px < 0.5 and found.share > 0.98


def test_a_stand_under_the_ball_does_not_count() -> None:
    _, mask = sphere(CENTER, RADIUS)
    stand = mask.astype(np.uint8)
    y, x = np.nonzero(mask)
    cv2.rectangle(stand, (int(x.mean()) - 30, int(y.max()) - 8), (int(x.mean()) + 30, SHAPE[0] - 1), 1, -1)
    bare, found = (ball_outline.fit(m, VIEW, at_border=False) for m in (mask, stand > 0))
    assert VIEW.focal * np.abs(found.ball.direction - bare.ball.direction).max() < 0.1
    assert found.share < 0.9


def egg(longer: float) -> Bools:
    picture = np.zeros((300, 300), np.uint8)
    return np.asarray(cv2.ellipse(picture, ((150, 150), (200, 200 * longer), 30), 1, -1)) > 0


def several() -> Bools:
    return sphere(np.array([0.1, 0.0, -1.0]), 0.05)[1] | sphere(np.array([0.3, 0.0, -1.0]), 0.06)[1]


@pytest.mark.parametrize(
    ("mask", "at_border", "words"),
    [
        (several(), False, "there are 2 objects in the picture; leave one ball in it"),
        (sphere(CENTER, RADIUS)[1], True, "cut by the picture's edge; show all of it"),
        (sphere(CENTER, 0.02)[1], False, "radius of 18 px on the maps, less than 24 px; move closer"),
        (egg(1.03), False, "from that of a ball, more than 0.8 px; use a true ball"),
        (egg(1.3), False, "of the object's outline lies on that of a ball, less than 70 %"),
    ],
    ids=["several", "cut", "small", "egg", "long egg"],
)
def test_an_object_that_is_no_single_ball_is_one_line(mask: Bools, at_border: bool, words: str) -> None:
    with pytest.raises(ObjectError, match=words):
        ball_outline.fit(mask, View(900.0, (150.0, 150.0), 2.0), at_border)
