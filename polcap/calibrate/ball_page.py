"""Page ball.html and picture ball.png of a validation: error map next to the normal map, and tables."""

from pathlib import Path
from typing import Any

import numpy as np

from polcap.calibrate.ball_validation import BallReport, ErrorClass, MeasuredBall
from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import frames
from polcap.optics.reduction import ObjectReduction
from polcap.report import keys, map_figures, page, sheets
from polcap.report.sheets import Tile

_LONGEST = 640  # px, longest side of a map


def write(folder: Path, name: str, found: MeasuredBall, texts: list[str]) -> None:
    """Write ball.html and ball.png into a result folder; `texts` are the lines of the measurements."""
    small = ObjectReduction(found.inside, _LONGEST)
    inside = small.share > 0.5
    normal, truth = (frames.unit(small.mean(part)) for part in (found.maps.normal, found.truth))
    error, expected = (small.mean(part.astype(np.float32)) for part in (found.error, found.maps.confidence))
    tiles = [
        Tile(_picture(normal, inside), "Normal", note="red right, green up, blue toward the camera"),
        Tile(keys.ERROR.picture(error, inside), "Error of the normal", keys.ERROR),
        Tile(keys.ERROR.picture(expected, inside), "Expected error of the normal", keys.ERROR),
    ]
    png.write(folder / "ball.png", sheets.sheet(tiles))
    content = {
        "name": name,
        "figures": found.figures,
        "lines": [text.split(maxsplit=1) for text in texts],
        "maps": [
            map_figures.normal("normal", "Normal", normal, inside),
            map_figures.scalar("measured", "Error of the normal", "against the ball", error, inside, keys.ERROR),
            map_figures.scalar("error", "Expected error", "as polcap states it", expected, inside, keys.ERROR),
            map_figures.normal("truth", "Normal of the ball", truth, inside),
        ],
        "tables": _tables(found.figures),
    }
    page.render("ball.html", folder / "ball.html", f"{name}: accuracy on a ball, polcap", content)


def _tables(found: BallReport) -> list[tuple[str, list[tuple[str, ...]]]]:
    """Tables of the errors by zenith angle and by expected error: title and rows."""
    return [
        ("Zenith angle", [_row(one, "") for one in found.by_zenith]),
        ("Expected error", [_row(one, ".1f") for one in found.by_expected]),
    ]


def _row(one: ErrorClass, form: str) -> tuple[str, ...]:
    """Row of a table: limits of a class, number of pixels, errors; `form` formats the limits."""
    limits = f"{one.least:{form or 'g'}}–{one.most:{form or 'g'}}°"
    errors = (f"{error:.2f}°" for error in (one.mean_deg, one.median_deg, one.expected_deg))
    return (limits, str(one.pixels), *errors)


def _picture(normal: Floats, inside: Any) -> Any:
    """Picture (H, W, 3) uint8 of a normal map (H, W, 3), black outside the ball."""
    return np.asarray(np.round((normal / 2 + 0.5) * 255 * inside[..., None]), np.uint8)
