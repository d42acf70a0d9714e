"""Gates of a flat sample: views, their tilts and focus, the board's paper, agreement with the fit, measured share."""

import math
from collections.abc import Mapping, Sequence
from statistics import median

from polcap.formats.capture import folder_names
from polcap.quality import several_views
from polcap.quality.gate_values import Gate
from polcap.quality.limits import MaterialGateLimits


def views(used: Sequence[str], left_out: Mapping[str, str], limits: MaterialGateLimits) -> Gate:
    """Gate on the number of used views."""
    few, remedy = "gloss and normals have large errors", "Shoot nine views: one from above, eight from the sides"
    return several_views.views(used, left_out, limits.min_views, few, remedy)


def tilts(tilt_deg: Mapping[str, float], limits: MaterialGateLimits) -> Gate:
    """Gate on the difference of the views' tilts: without it, slopes, albedo and gloss cannot be separated."""
    value, limit = max(tilt_deg.values()), limits.min_tilt_deg
    message = f"The most oblique view is tilted by {value:.0f}°, the steepest by {min(tilt_deg.values()):.0f}°"
    if value - min(tilt_deg.values()) >= limit:
        return Gate("tilts", "pass", value, limit, message, unit="°")
    return Gate("tilts", "fail", value, limit, message, "Shoot from the sides too, tilted by 20 to 45°", unit="°")


def focus(blur_px: Mapping[str, float], limits: MaterialGateLimits) -> Gate:
    """Gate on the views' blur against that of the median view, 1σ [merged px], measured on the board's edges."""
    limit, known = limits.max_blur_px, {name: blur for name, blur in blur_px.items() if math.isfinite(blur)}
    if not known:
        return Gate("focus", "not measured", None, limit, "No edge of the board is visible", unit="px")
    middle = median(known.values())
    more = {name: math.sqrt(max(blur**2 - middle**2, 0)) for name, blur in known.items()}
    value, blurred = max(more.values()), [name for name, one in more.items() if one > limit]
    if not blurred:
        return Gate("focus", "pass", value, limit, "The views are equally sharp", unit="px")
    names = folder_names.few_names(blurred)
    message = f"{names}: less sharp than the median view by up to {value:.1f} px (1σ)"
    remedy = f"Shoot {names} again: focus on the sample, close the aperture, hold the camera still"
    return Gate("focus", "warn", value, limit, message, remedy, unit="px")


def paper(shine: float, limits: MaterialGateLimits) -> Gate:
    """Gate on the highlight of the board's paper, relative to its diffuse light: it disturbs the light of the views."""
    message, limit = f"The board's paper has a highlight of {shine:.0%} of its diffuse light", limits.max_paper_shine
    if shine <= limit:
        return Gate("paper", "pass", shine, limit, message)
    remedy = "Print the board on matt paper, and do not laminate it; each view's light is less certain"
    return Gate("paper", "warn", shine, limit, message, remedy)


def agreement(residual: Mapping[str, float], limits: MaterialGateLimits) -> Gate:
    """Gate on the difference between a view's radiance and that of the fitted material."""
    worst, limit = max(residual, key=lambda name: residual[name]), limits.max_residual
    value = residual[worst]
    message = f"Photographs and fitted material agree within {100 * value:.1f} % (median); the worst is {worst}"
    if value <= limit:
        return Gate("agreement", "pass", value, limit, message)
    remedy = f"Look for shadows, reflections or blur in {worst}; move it out of the folder, and run again"
    return Gate("agreement", "fail", value, limit, message, remedy)


def seen(share: float, limits: MaterialGateLimits) -> Gate:
    """Gate on the share of the texels that three views or more have measured."""
    message, limit = f"Three views or more measured {share:.0%} of the texels; the rest is filled", limits.min_seen
    if share >= limit:
        return Gate("seen", "pass", share, limit, message)
    return Gate("seen", "warn", share, limit, message, "Show the whole sample in every view, and expose darker")
