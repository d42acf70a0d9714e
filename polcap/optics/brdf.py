"""The GGX microfacet model: normal distribution and Smith masking. α = roughness². Works on NumPy and torch.

References
----------
Walter et al., Microfacet models for refraction through rough surfaces, EGSR 2007, eqs. (33), (34).
"""

from math import pi
from typing import Any


def ggx_distribution(cos_h: Any, alpha: Any) -> Any:
    """GGX density D(h) [1/sr] of facet normals, from cos_h = n·h > 0 and α."""
    a2 = alpha * alpha
    return a2 / (pi * ((a2 - 1) * cos_h * cos_h + 1) ** 2)


def smith_masking(cos_i: Any, cos_o: Any, alpha: Any) -> Any:
    """Smith's masking and shadowing factor G = G₁(i) G₁(o) of GGX facets, separable form."""
    return _g1(cos_i, alpha) * _g1(cos_o, alpha)


def _g1(c: Any, alpha: Any) -> Any:
    """Smith's masking G₁ = 2c/(c + √(α² + (1 − α²) c²)) of one direction with cosine c."""
    a2 = alpha * alpha
    return 2 * c / (c + (a2 + (1 - a2) * c * c) ** 0.5)
