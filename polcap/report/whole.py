"""A run's results, as the gates look at them: at full size."""

from dataclasses import dataclass

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
from polcap.path import Results


@dataclass(frozen=True)
class Whole:
    """A run's results, as the gates look at them."""

    results: Results
    focal_doubt: tuple[float, float]
    grid_px: float = 1.0
    chart_missing: str = ""  # without a chart, and none asked away, a run ends

    @property
    def names(self) -> list[str]:
        return [f"{degrees:g}°" for degrees in np.round(np.degrees(self.radiance.angle), 6)]

    @property
    def clipped(self) -> Floats:
        inside = self.results.object_.value.mask
        return np.array([((bits[inside] & int(Quality.CLIPPED)) > 0).mean() for bits in self.radiance.quality])

    @property
    def radiance(self) -> AngleStack:
        return self.results.radiance.value

    @property
    def color(self) -> ColorCalibration:
        return self.results.color.value

    @property
    def alignment(self) -> Alignment:
        return self.results.alignment.value

    @property
    def object_(self) -> ObjectMask:
        return self.results.object_.value

    @property
    def gains(self) -> Gains:
        return self.results.gains.value

    @property
    def stokes(self) -> StokesImage:
        return self.results.stokes.value

    @property
    def maps(self) -> SurfaceMaps:
        return self.results.maps.value

    @property
    def mesh(self) -> Mesh:
        return self.results.mesh.value
