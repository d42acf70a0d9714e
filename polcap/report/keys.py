"""Color keys of maps: how values become colors in a picture, and how colors are read back as values.

Each pixel of a map's picture has one of 255 levels; level 0 is outside the object. No two levels share a color, so
a program can read the numbers back from the picture.
"""

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats

Palette = Literal["inferno", "viridis", "wheel", "balance"]
LEVELS = 255
_SHARES = np.linspace(0, 1, LEVELS)  # of the levels


@dataclass(frozen=True)
class ColorKey:
    """Color key of one map: range of values, unit and palette."""

    low: float
    high: float
    unit: str  # printed after a number
    ticks: tuple[float, ...]  # numbers marked on the bar
    palette: Palette = "viridis"
    power: float = 1.0  # number = low + (high − low)·level^power: 2 gives small numbers more levels
    digits: int = 2  # behind the decimal point

    def level(self, value: Floats, inside: Bools) -> NDArray[np.uint8]:
        """Convert values low…high to levels 1…255, clipped; 0 outside the object and for values that are not finite."""
        known = inside & np.isfinite(value)
        share = (np.where(known, value, self.low) - self.low) / (self.high - self.low)
        if self.palette == "wheel":
            steps = np.rint(np.mod(share, 1.0) * LEVELS) % LEVELS
        else:
            steps = np.rint(np.clip(share, 0, 1) ** (1 / self.power) * (LEVELS - 1))
        return np.where(known, steps + 1, 0).astype(np.uint8)

    def place(self, value: float) -> float:
        """Position of a value on the color bar, 0…1."""
        return float(np.clip((value - self.low) / (self.high - self.low), 0, 1) ** (1 / self.power))

    def picture(self, value: Floats, inside: Bools) -> NDArray[np.uint8]:
        """Convert values to colors (H, W, 3), black outside the object."""
        return np.concatenate([np.zeros((1, 3), np.uint8), colors(self.palette)])[self.level(value, inside)]

    def bar(self, width: int, height: int) -> NDArray[np.uint8]:
        """Picture of the color bar from low to high, (height, width, 3)."""
        steps = np.rint(np.linspace(0, LEVELS - 1, width)).astype(int)
        return np.broadcast_to(colors(self.palette)[steps], (height, width, 3)).copy()


def colors(palette: Palette) -> NDArray[np.uint8]:
    """sRGB colors (255, 3) of the levels 1…255 of a palette, all different."""
    if palette == "wheel":  # one turn of hue, red at both ends
        hsv = np.stack([360 * np.arange(LEVELS) / LEVELS, np.full(LEVELS, 0.78), np.ones(LEVELS)], axis=-1)
        rgb: Any = cv2.cvtColor(hsv[None].astype(np.float32), cv2.COLOR_HSV2RGB)[0]
    elif palette == "balance":  # blue, gray at zero, red
        ends = np.array([[0.10, 0.42, 0.90], [0.55, 0.55, 0.55], [0.95, 0.35, 0.10]])
        rgb = np.stack([np.interp(_SHARES, [0, 0.5, 1], ends[:, channel]) for channel in range(3)], axis=-1)
    else:
        ramp = np.arange(256, dtype=np.uint8)[None]
        kind = cv2.COLORMAP_INFERNO if palette == "inferno" else cv2.COLORMAP_VIRIDIS
        rgb = cv2.applyColorMap(ramp, kind)[0, 1:, ::-1] / 255
    return _distinct(np.rint(np.asarray(rgb) * 255).astype(np.int64))


def _distinct(rgb: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Make all colors of a palette different: repeated ones are shifted by one step of blue."""
    seen: set[tuple[int, ...]] = set()
    out = rgb.copy()
    for color in out:
        while tuple(color) in seen:
            color[2] += 1 if color[2] < 255 else -255
        seen.add(tuple(color))
    return out.astype(np.uint8)


DOLP = ColorKey(0, 0.2, "", (0, 0.05, 0.1, 0.15, 0.2), "inferno", digits=3)
AOLP = ColorKey(0, 180, "°", (0, 45, 90, 135, 180), "wheel", digits=0)
ALBEDO = ColorKey(0, 1, "", (0, 0.25, 0.5, 0.75, 1))
ROUGHNESS = ColorKey(0, 1, "", (0, 0.25, 0.5, 0.75, 1))
F0 = ColorKey(0, 0.16, "", (0, 0.04, 0.08, 0.12, 0.16), digits=3)
ERROR = ColorKey(0, 30, "°", (0, 1, 3, 10, 20, 30), "inferno", power=2, digits=1)  # 3° at a third of the bar
MATERIAL_ERROR = ColorKey(0, 0.4, "", (0, 0.01, 0.05, 0.1, 0.2, 0.4), "inferno", power=2, digits=3)
DIFFERENCE = ColorKey(-20, 20, " %", (-20, -10, 0, 10, 20), "balance", digits=1)
SIGMA = ColorKey(0, 0.01, "", (0, 0.0025, 0.005, 0.01), "inferno", digits=4)


def depth(values: Floats, metric: bool) -> ColorKey:
    """Color key of a depth map, from the object's nearest to its farthest point; in mm where the scale is known."""
    low, high = (float(edge) for edge in np.percentile(values, [0.5, 99.5])) if values.size else (0.0, 1.0)
    if high - low < 1e-9:
        high = low + 1.0
    ticks = tuple(float(tick) for tick in np.linspace(low, high, 4))
    return ColorKey(low, high, " mm" if metric else "", ticks, digits=1 if metric else 3)
