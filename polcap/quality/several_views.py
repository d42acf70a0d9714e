"""Gates of several views of one thing: the number of used views, and their poses."""

from collections.abc import Mapping, Sequence

from polcap.formats.capture import folder_names
from polcap.quality.gate_values import Gate


def views(used: Sequence[str], left_out: Mapping[str, str], least: int, few: str, remedy: str) -> Gate:
    """Gate on the number of used views. It names views that are left out, and numbers that no folder has.

    `few` states what is wrong with fewer views than `least`, `remedy` how many to shoot.
    """
    count, missing = len(used), folder_names.missing_views([*used, *left_out])
    absent = f"; no folder {folder_names.few_names(missing)}" if missing else ""
    if left_out:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        message = f"{len(left_out)} of {count + len(left_out)} views are left out: {reasons}{absent}"
        again = "Shoot these views again, or move them out of the folder"
        return Gate("views", "warn", count, least, message, again, unit="")
    if count < least:
        return Gate("views", "warn", count, least, f"{count} views are few: {few}{absent}", remedy, unit="")
    return Gate("views", "pass", count, least, f"All {count} views are used{absent}", unit="")


def poses(residual_px: Mapping[str, float], limit: float, board: bool) -> Gate:
    """Gate on the rms distance of a view's board corners, or features, from where its pose projects them."""
    worst = max(residual_px, key=lambda name: residual_px[name])
    value, points = residual_px[worst], "The board's corners" if board else "Features of the object"
    message = f"{points} are within {value:.2f} px (rms) in every view; the worst is {worst}"
    if value <= limit:
        return Gate("poses", "pass", value, limit, message, unit="px")
    support = "Keep the board flat, and" if board else "Turn the object on a flat table,"
    return Gate("poses", "fail", value, limit, message, f"{support} focus and zoom unchanged", unit="px")
