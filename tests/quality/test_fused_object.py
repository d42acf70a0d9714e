"""The advice for a surface that no view saw fits the direction in which it faces."""

import numpy as np
import pytest

from polcap.quality import fused_object
from polcap.quality.fused_object import SeenSurface
from polcap.quality.limits import FusedGateLimits

FULL = FusedGateLimits().min_views


def surface(**unseen: float) -> SeenSurface:
    """A surface of which no view saw these shares of its texels, by where they face."""
    count = 1000
    height = np.repeat([-1.0, 0.0, 1.0], [300, 400, 300])
    seen = np.ones(len(height), bool)
    for side, start in (("down", 0), ("side", 300), ("up", 700)):
        seen[start : start + round(count * unseen.get(side, 0.0))] = False
    return SeenSurface.measure(seen, height)


@pytest.mark.parametrize(
    ("unseen", "views", "state", "words"),
    [
        ({"down": 0.3}, FULL, "pass", ""),
        ({"down": 0.28, "side": 0.03}, FULL, "pass", ""),
        ({"down": 0.3, "side": 0.15}, FULL, "warn", "its underside"),
        ({"up": 0.2, "down": 0.1}, FULL, "warn", "from higher up"),
        ({"side": 0.25}, FULL, "warn", "seen.png"),
        ({"side": 0.25}, 3, "warn", "Shoot more views"),
        ({"up": 0.1}, FULL, "pass", ""),
    ],
)
def test_unseen_surface_gets_the_views_that_would_see_it(
    unseen: dict[str, float], views: int, state: str, words: str
) -> None:
    gate = fused_object.seen(surface(**unseen), views, FusedGateLimits())
    assert gate.state == state and words in gate.remedy and bool(gate.remedy) is (state == "warn")
    assert gate.value == pytest.approx(1 - sum(unseen.values()))


def test_shares_of_unseen_surface_add_up_to_one() -> None:
    found = surface(down=0.1, side=0.2, up=0.05)
    assert (found.seen, found.down, found.side, found.up) == pytest.approx((0.65, 0.1, 0.2, 0.05))
