"""Relative uncertainty of the scale of all albedos, from the chart and from the plausibility of the maps.

A chart behind the object, or in a shadow, gets less light than the object. Nothing in the picture of the chart shows
this, but all albedos then come out too high: colors approach 1, and F0 exceeds that of common dielectrics.
"""

from math import hypot, log

import numpy as np

from polcap.images import SurfaceMaps

_MAPS_SIGMA = 0.05  # of the estimators' own albedos, with a correct scale (docs/benchmarks/gates.md)
_COMMON_F0 = 0.05  # median of an object; an index of 1.58
_F0_RESPONSE = 0.3  # change of ln F0 per change of ln scale: the network expects common values (20 captures)
_COMMON_WHITE, _WHITE_RANGE = 0.9, 0.14  # 95th percentile of the albedo: usual limit; excess that doubts a factor of e


def albedo_sigma(maps: SurfaceMaps, of_chart: float | None) -> float | None:
    """Relative 1σ of the scale of all albedos; `of_chart` is that of the light on the chart, None without a chart."""
    if of_chart is None or not maps.mask.any():
        return None
    gloss = log(max(float(np.median(maps.specular[maps.mask].mean(-1))) / _COMMON_F0, 1.0)) / _F0_RESPONSE
    white = max(float(np.percentile(maps.diffuse[maps.mask].max(-1), 95)) - _COMMON_WHITE, 0.0) / _WHITE_RANGE
    return hypot(of_chart, _MAPS_SIGMA, max(gloss, white))
