"""A run's results, as the gates look at them: at full size; their pixels only where no figure of them is remembered."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from polcap.images import (
    Alignment,
    AngleStack,
    ColorCalibration,
    Floats,
    Gains,
    Mesh,
    ObjectMask,
    Quality,
    StokesImage,
    SurfaceMaps,
)
from polcap.pipeline.cache import StageResult
from polcap.pipeline.path import Results
from polcap.quality.gate import Found
from polcap.remembered import Remembered

T = TypeVar("T")


@dataclass(frozen=True)
class Whole:
    """A run's results, as the gates look at them."""

    results: Results
    focal_doubt: tuple[float, float]
    remembered: Remembered = field(default_factory=Remembered)
    pixels: bool = False  # large arrays are there, not only their shapes
    grid_px: float = 1.0
    chart_missing: str = ""  # without a chart, and none asked away, a run ends

    def figure(self, name: str, measure: Callable[[Found, Any], Any], setting: Any = None) -> Any:
        """What `measure` gives of the pixels, or gave of the same results with the same setting."""
        made_from = [[kept.key for kept in vars(self.results).values() if kept is not self.results.asset], setting]
        return self.remembered(f"gate_{name}", made_from, partial(measure, replace(self, pixels=True), setting))

    @property
    def names(self) -> list[str]:
        return [f"{degrees:g}°" for degrees in np.round(np.degrees(self.radiance.angle), 6)]

    @property
    def clipped(self) -> Floats:
        return np.array(self.figure("clipped", _clipped))

    @property
    def radiance(self) -> AngleStack:
        return self._of(self.results.radiance)

    @property
    def color(self) -> ColorCalibration:
        return self._of(self.results.color)

    @property
    def alignment(self) -> Alignment:
        return self._of(self.results.alignment)

    @property
    def object_(self) -> ObjectMask:
        return self._of(self.results.object_)

    @property
    def gains(self) -> Gains:
        return self._of(self.results.gains)

    @property
    def stokes(self) -> StokesImage:
        return self._of(self.results.stokes)

    @property
    def maps(self) -> SurfaceMaps:
        return self._of(self.results.maps)

    @property
    def mesh(self) -> Mesh:
        return self._of(self.results.mesh)

    def _of(self, result: StageResult[T]) -> T:
        return result.value if self.pixels else result.facts


def _clipped(found: Found, _: None) -> list[float]:
    inside = found.object_.mask
    return [float(((bits[inside] & int(Quality.CLIPPED)) > 0).mean()) for bits in found.radiance.quality]
