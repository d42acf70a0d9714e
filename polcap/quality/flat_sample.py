"""Gates of a flat sample: its views, their tilts and poses, their agreement with the fit, the measured share."""

from collections.abc import Mapping

from polcap.quality.gate import Gate
from polcap.quality.limits import MaterialGateLimits


def views(count: int, left_out: Mapping[str, str], limits: MaterialGateLimits) -> Gate:
    """Gate on the number of used views; names views that are left out."""
    limit = limits.min_views
    if left_out:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        message = f"{len(left_out)} of {count + len(left_out)} views are left out: {reasons}"
        return Gate("views", "warn", count, limit, message, "Shoot these views again, or delete them", unit="")
    if count < limit:
        message = f"{count} views are few: gloss and normals have large errors"
        return Gate(
            "views", "warn", count, limit, message, "Shoot nine views: one from above, eight from the sides", unit=""
        )
    return Gate("views", "pass", count, limit, f"All {count} views are used", unit="")


def tilts(tilt_deg: Mapping[str, float], limits: MaterialGateLimits) -> Gate:
    """Gate on the difference of the views' tilts: without it, slopes, albedo and gloss cannot be separated."""
    value, limit = max(tilt_deg.values()), limits.min_tilt_deg
    message = f"The most oblique view is tilted by {value:.0f}°, the steepest by {min(tilt_deg.values()):.0f}°"
    if value - min(tilt_deg.values()) >= limit:
        return Gate("tilts", "pass", value, limit, message, unit="°")
    return Gate("tilts", "fail", value, limit, message, "Shoot from the sides too, tilted by 20 to 45°", unit="°")


def poses(residual_px: Mapping[str, float], limits: MaterialGateLimits) -> Gate:
    """Gate on the rms distance of a view's board corners from where its pose projects them."""
    worst = max(residual_px, key=lambda name: residual_px[name])
    value, limit = residual_px[worst], limits.max_corner_px
    message = f"The board's corners are within {value:.2f} px (rms) in every view; the worst is {worst}"
    if value <= limit:
        return Gate("poses", "pass", value, limit, message, unit="px")
    return Gate("poses", "fail", value, limit, message, "Keep the board flat, and focus and zoom unchanged", unit="px")


def agreement(residual: Mapping[str, float], limits: MaterialGateLimits) -> Gate:
    """Gate on the difference between a view's radiance and that of the fitted material."""
    worst, limit = max(residual, key=lambda name: residual[name]), limits.max_residual
    value = residual[worst]
    message = f"Photographs and fitted material agree within {100 * value:.1f} % (median); the worst is {worst}"
    if value <= limit:
        return Gate("agreement", "pass", value, limit, message)
    remedy = f"Look for shadows, reflections or blur in {worst}; delete it, and run again"
    return Gate("agreement", "fail", value, limit, message, remedy)


def seen(share: float, limits: MaterialGateLimits) -> Gate:
    """Gate on the share of the texels that three views or more have measured."""
    message, limit = f"Three views or more measured {share:.0%} of the texels; the rest is filled", limits.min_seen
    if share >= limit:
        return Gate("seen", "pass", share, limit, message)
    return Gate("seen", "warn", share, limit, message, "Show the whole sample in every view, and expose darker")
