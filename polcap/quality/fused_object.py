"""Gates of a fused object: its views, their poses and normals, the seen share, the closed mesh, and joined sets.

A set holds the views of the object lying on one side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from polcap.image_values import Bools, Floats
from polcap.quality import several_views
from polcap.quality.gate_values import Gate
from polcap.quality.limits import FusedGateLimits

_STEEP = 0.5  # upward component of a normal: faces up or down by more than 30°


def views(used: Sequence[str], left_out: Mapping[str, str], limits: FusedGateLimits) -> Gate:
    """Gate on the number of used views."""
    few = "parts between them are guessed from outlines"
    return several_views.views(used, left_out, limits.min_views, few, "Shoot 12 views or more")


def poses(residual_px: Mapping[str, float], board: bool, limits: FusedGateLimits) -> Gate:
    """Gate on the rms distance of a view's board corners, or features, from where its pose projects them."""
    return several_views.poses(residual_px, limits.max_corner_px if board else limits.max_feature_px, board)


def agreement(normal_deg: Mapping[str, float], limits: FusedGateLimits) -> Gate:
    """Gate on the views whose normals contradict the fused mesh, as after a swap of polarizer angles."""
    worst, limit = max(normal_deg, key=lambda name: normal_deg[name]), limits.max_normal_deg
    value, bad = normal_deg[worst], ", ".join(name for name, angle in normal_deg.items() if angle > limit)
    if bad:
        message = f"The normals of {bad} contradict the mesh, by {value:.0f}° in the worst view"
        remedy = f"Check the polarizer angles of {bad}, or move them out of the folder and fuse again"
        return Gate("agreement", "fail", value, limit, message, remedy, unit="°")
    message = f"Normals of all views are within {value:.0f}° of the mesh (median); the worst is {worst}"
    return Gate("agreement", "pass", value, limit, message, unit="°")


def join(folder: str, shared: float, limits: FusedGateLimits) -> Gate:
    """Gate on the share of a further set's surface that the first set confirms; it passes, else `fuse` ends earlier."""
    message = f"The first set confirms {shared:.0%} of the surface of {folder}"
    return Gate(f"join {folder}", "pass", shared, limits.min_shared, message)


@dataclass(frozen=True)
class SeenSurface:
    """Share of the surface that a view saw, and where the rest faces; all shares are of the whole surface."""

    seen: float
    down: float  # unseen, faces down
    side: float  # unseen, faces sideways
    up: float  # unseen, faces up

    @classmethod
    def measure(cls, seen: Bools, height: Floats) -> Self:
        """Measure it on N texels: whether a view saw them (N,), and the upward component (N,) of their normals."""
        down, up = height < -_STEEP, height > _STEEP
        parts = (float((~seen & part).mean()) for part in (down, ~down & ~up, up))
        return cls(float(seen.mean()), *parts)


def seen(surface: SeenSurface, view_count: int, limits: FusedGateLimits) -> Gate:
    """Gate on the share of the surface that a view saw; the underside is left out."""
    limit, share = limits.min_seen, surface.seen
    above = share / max(1 - surface.down, 1e-9)  # of the surface without the unseen underside
    most = max(("down", "side", "up"), key=lambda side: float(getattr(surface, side)))
    where = {"down": "faces down", "side": "faces sideways", "up": "faces up"}[most]
    message = f"Views saw {share:.0%} of the surface; the rest, which mostly {where}, is filled"
    if share >= limit or above >= limit:
        return Gate("seen", "pass", share, limit, message)
    remedies = {
        "down": "Turn the object over and take a second set of views of its underside (setB)",
        "side": "Shoot more views, from the sides that seen.png in maps/ shows black",
        "up": "Take a second ring of views from higher up",
    }
    few = view_count < limits.min_views and most == "side"
    return Gate("seen", "warn", share, limit, message, "Shoot more views" if few else remedies[most])


def closed(every_edge: bool) -> Gate:
    """Gate on whether every edge of the mesh belongs to two triangles."""
    if every_edge:
        return Gate("closed", "pass", None, None, "Every edge of the mesh belongs to two triangles")
    return Gate("closed", "fail", None, None, "The mesh has open edges", "Report this as a bug")
