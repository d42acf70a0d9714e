"""Advice on how to correct the polarizer angles that a capture states, in words of its layout."""

import numpy as np

from polcap.capture_values import AngleStatement, ShotOrder
from polcap.image_values import Floats


def correct(statement: AngleStatement, order: ShotOrder, angle: Floats) -> str:
    """Advice on how to correct the stated angles (K,) rad to another order and sense."""
    if statement.place == "cells":
        return _cells(statement, (-1 if order.mirrored else 1) * np.degrees(angle)[list(order.shots)])
    texts = statement.texts or tuple(f"{degrees:g}°" for degrees in np.degrees(angle))
    moved = [(texts[k], texts[stated]) for k, stated in enumerate(order.shots) if k != stated]
    changes, many = " and ".join(f"{old} to {new}" for old, new in moved), "s" * (len(moved) > 1)
    change = {
        "folders": f"rename the folder{many} {changes}",
        "file names": f"rename the file{many} {changes}",
        "capture.toml": f"change the angle{many} in capture.toml: {changes}",
        "order": f"give the order --angles {','.join(texts[stated] for stated in order.shots)}",
    }[statement.place]
    sense = {
        "": "add --clockwise, or clockwise = true in capture.toml",
        "stated": "leave out --clockwise, and clockwise in capture.toml",
        "calibrated": "repeat `polcap calibrate`: its ring counts the other way",
    }[statement.clockwise]
    return ", and ".join([change] * bool(moved) + [sense] * order.mirrored)


def turn(statement: AngleStatement, angle: Floats, by: float) -> str:
    """Advice for stated angles (K,) rad that are all too small by `by` rad."""
    if statement.place != "cells":
        return "set the ring's zero to the horizontal, or state the true angles"
    steps = round(float(by) / (np.pi / 4))
    return _cells(statement, np.degrees(angle) + 45 * steps) if steps else "use the frame as the sensor delivers it"


def retake(statement: AngleStatement) -> str:
    """Advice for one shot of another angle than stated."""
    ring = "set the ring to its mark and take the shot again, or state its true angle"
    return check_statement(statement) if statement.place == "cells" else ring


def check_statement(statement: AngleStatement) -> str:
    """Advice to check the stated angles: the pictures contradict them, and do not show which are right."""
    return {
        "folders": "check the names of the folders and the ring's marks",
        "file names": "check the names of the files and the ring's marks",
        "capture.toml": "check the angles in capture.toml and the ring's marks",
        "order": "check the order of the shots (--angles) and the ring's marks",
        "cells": "check the sensor's data sheet, and state its `cells` in capture.toml",
    }[statement.place]


def _cells(statement: AngleStatement, degrees: Floats) -> str:
    """Advice to state these angles (K,) in the cells of a polarization sensor."""
    grid = {cell: round(float(one)) % 180 for cell, one in zip(statement.cells, degrees)}
    unused = iter({0, 45, 90, 135} - set(grid.values()))
    rows = [[grid[y, x] if (y, x) in grid else next(unused) for x in (0, 1)] for y in (0, 1)]
    return f"state the angles of the sensor's cells in capture.toml: cells = {rows}"
