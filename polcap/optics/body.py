"""Diffuse reflection of rough surfaces: intensity and polarization, from the visible GGX microfacets.

Each facet is a smooth Fresnel interface. Below the surface light is unpolarized. The camera at zenith angle θ sees the
distribution of visible normals m about the ray v. So S0 ∝ ⟨T₊(v·m)⟩, and S1 along the projected normal is
∝ ⟨T₋(v·m) cos 2φ_m⟩, with φ_m the facet's azimuth about the ray. Where light spreads farther inside the body than a
facet is wide (`local` 0), all facets count alike. Where it does not (`local` 1), each facet counts by the flash light
that enters it, (v·m) T₊(v·m). α = 0 is the smooth interface. Means over facets come from a table that is integrated at
first use. Works on NumPy and torch.

References
----------
Heitz, Sampling the GGX distribution of visible normals, JCGT 2018.
Ichikawa et al., Fresnel microfacet BRDF, CVPR 2023.
Oren & Nayar, Generalization of Lambert's reflectance model, SIGGRAPH 1994.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from array_api_compat import device

from polcap.image_values import Floats
from polcap.optics import fresnel
from polcap.optics.namespace import array_namespace

_COSINES = np.linspace(0, 1, 49)
_ALPHAS = np.linspace(0, 1, 21)
_INDICES = np.linspace(1.3, 1.7, 3)
_AROUND, _ALONG = 48, 96  # numbers of azimuths and of slopes of the facets that are summed
_LEAST_COSINE = 1e-4
_GRAZING = 0.1  # cosine; at smaller ones the shading factor stays constant
_SEEN = 0.25  # least cosine at which the shading is fitted: zenith angles up to 75°


@dataclass(frozen=True)
class Law:
    """Parameters of the diffuse reflection of each pixel: roughness of the interface, spread of light inside, DoLP."""

    rough: Any = 0.0  # α for diffuse reflection over α of the gloss; 0: a smooth interface
    local: Any = 0.0  # 0…1: share of light that leaves through the facet by which it entered
    dolp_factor: Any = 1.0  # factor on S1 and S2, for depolarization by depth, fibers and dust

    def at(self, which: Any) -> "Law":
        """The parameters of the pixels that an index or mask selects."""
        return Law(*(x if isinstance(x, float) else x[which] for x in (self.rough, self.local, self.dolp_factor)))


SMOOTH = Law()


def leaving(c: Any, alpha: Any, ior: Any, local: Any = 0.0) -> tuple[Any, Any]:
    """Transmittance of diffuse light through the visible facets: mean T₊, and the part polarized along the normal.

    c (...,) is the cosine of the zenith angle, alpha the GGX α 0…1, ior the refractive index, local `Law.local`; all
    broadcast. Both results have their shape (...,).
    """
    plus, minus = fresnel.transmission(c, ior)
    extra, even, weighted = _interpolate_table(c, alpha, ior)
    share = even + local * (weighted - even)
    return plus + extra, (plus + extra) * share * minus / plus


def dolp(c: Any, alpha: Any, ior: Any, local: Any = 0.0) -> Any:
    """Degree of linear polarization (...,) of diffuse reflection; arguments as for `leaving`."""
    plus, minus = leaving(c, alpha, ior, local)
    return minus / plus


def flattening(cos_i: Any, cos_o: Any, between: Any, alpha: Any) -> Any:
    """Factor (...,) on Lambert's shading by which rough surfaces (`local` 1) look flatter; 1 facing the camera.

    Under a light near the camera, facets that face the light brighten surfaces near the occluding contour. The factor
    is 1 + B(α) sin θᵢ sin θₒ max(0, cos Δφ) / (g (1 + g)), g = max(cos θᵢ, cos θₒ), close to Oren & Nayar's form; B is
    fitted to the facets. With the flash at the lens it is 1 + B (1/cos θ − 1). Oren & Nayar's A is 1 here, because
    albedo is that of a surface facing the camera.

    cos_i and cos_o (...,) are the cosines of light and camera against the normal, between (...,) the cosine of the
    angle from light to camera, alpha (...,) the GGX α 0…1.
    """
    xp = array_namespace(cos_o)
    strengths = xp.asarray(_strengths(), dtype=cos_o.dtype, device=device(cos_o))
    at, share = _step(xp, alpha, _ALPHAS)
    strength = strengths[at] * (1 - share) + strengths[at + 1] * share
    greater = xp.clip(xp.where(cos_i > cos_o, cos_i, cos_o), _GRAZING, None)
    return 1 + strength * xp.clip(between - cos_i * cos_o, 0.0, None) / (greater * (1 + greater))


def _interpolate_table(c: Any, alpha: Any, ior: Any) -> tuple[Any, Any, Any]:
    """Trilinear interpolation of `_table` at cosine, α and index: three values (...,)."""
    xp = array_namespace(c)
    table = xp.asarray(_table().reshape(-1, 3), dtype=c.dtype, device=device(c))
    zero = 0 * c
    (ni, nf), (ai, af), (ci, cf) = (
        _step(xp, zero + x, nodes) for x, nodes in ((ior, _INDICES), (alpha, _ALPHAS), (c, _COSINES))
    )
    out: Any = 0.0
    for n, wn in ((ni, 1 - nf), (ni + 1, nf)):
        for a, wa in ((ai, 1 - af), (ai + 1, af)):
            row = (n * len(_ALPHAS) + a) * len(_COSINES) + ci
            weight = wn * wa
            out = out + (weight * (1 - cf))[..., None] * table[row] + (weight * cf)[..., None] * table[row + 1]
    return out[..., 0], out[..., 1], out[..., 2]


def _step(xp: Any, x: Any, nodes: Floats) -> tuple[Any, Any]:
    """Index of the node below each x, and the fraction 0…1 of the way to the next node; x is clipped to the nodes."""
    place = xp.clip((x - float(nodes[0])) * ((len(nodes) - 1) / float(nodes[-1] - nodes[0])), 0.0, len(nodes) - 1.0)
    at = xp.astype(xp.clip(xp.floor(place), 0.0, len(nodes) - 2.0), xp.int64)
    return at, place - at


@lru_cache(maxsize=1)
def _table() -> Floats:
    """Table of diffuse reflection, (3, 21, 49, 3): refractive index, α, cosine of the zenith angle, value.

    The three values compare a rough interface with the smooth one: its mean transmittance T₊ minus that of the smooth
    interface, and its DoLP over that of the smooth interface, for `Law.local` 0 and 1.
    """
    out = np.zeros((len(_INDICES), len(_ALPHAS), len(_COSINES), 3))
    out[..., 1:] = 1.0
    cosine = np.maximum(_COSINES, _LEAST_COSINE)
    for j, alpha in enumerate(_ALPHAS[1:], start=1):
        c, cos_2phi, weight = facets(cosine, float(alpha))
        for i, ior in enumerate(_INDICES):
            plus, minus = fresnel.transmission(c, ior)
            smooth_plus, smooth_minus = fresnel.transmission(cosine, ior)
            mean = (weight * plus).sum(axis=1)
            even = (weight * minus * cos_2phi).sum(axis=1) / mean
            weighted = weight * c * plus
            local = (weighted * minus * cos_2phi).sum(axis=1) / (weighted * plus).sum(axis=1)
            out[i, j, :, 0] = mean - smooth_plus
            # near the normal both DoLPs go to 0 as sin²θ: their ratio there is extrapolated
            ratio = np.stack([even, local], axis=1)[:-1] / (smooth_minus / smooth_plus)[:-1, None]
            out[i, j, :, 1:] = np.concatenate([ratio, 2 * ratio[-1:] - ratio[-2:-1]])
    return out


@lru_cache(maxsize=1)
def _strengths() -> Floats:
    """The coefficient B of `flattening` at each α (21,), for index 1.5, by least squares over zeniths up to 75°."""
    cosine = np.linspace(_SEEN, 1, 40)
    term = 1 / cosine - 1
    out = np.zeros(len(_ALPHAS))
    for j, alpha in enumerate(_ALPHAS[1:], start=1):
        c, _, weight = facets(cosine, float(alpha))
        plus, _ = fresnel.transmission(c, 1.5)
        lambert = cosine * (weight * plus).sum(axis=1) ** 2
        ratio = (weight * c * plus * plus).sum(axis=1) / lambert
        out[j] = (term * (ratio / ratio[-1] - 1)).sum() / (term * term).sum()
    return out


def facets(cosine: Floats, alpha: float) -> tuple[Floats, Floats, Floats]:
    """Visible facets of surfaces seen at cosines (N,): v·m, cos 2φ_m and weight, (N, M) each; weights sum to 1.

    Facets have even steps of azimuth and of s, with the slope tan θ_m = α √(1 − (1 − s)²)/(1 − s). Then the GGX density
    of slopes is 2 (1 − s) ds. The weight is 1 − s times the projected area v·m/cos θ_m, finite where slopes are not.
    """
    s, around = np.meshgrid(
        (np.arange(_ALONG) + 0.5) / _ALONG, (np.arange(_AROUND) + 0.5) * np.pi / _AROUND, indexing="ij"
    )
    slope, turn = (alpha * np.sqrt(1 - (1 - s) ** 2) / (1 - s)).ravel(), around.ravel()
    upright = 1 / np.sqrt(1 + slope**2)
    facet = np.stack([slope * np.cos(turn), slope * np.sin(turn), np.ones_like(slope)]) * upright  # about the normal
    sine = np.sqrt(1 - cosine**2)
    along = cosine[:, None] * facet[2] + sine[:, None] * facet[0]  # v·m
    x = sine[:, None] * facet[2] - cosine[:, None] * facet[0]  # across the ray, towards the projected normal
    y = facet[1]
    weight = np.maximum(along, 0) / upright * (1 - s).ravel()
    across = np.maximum(x * x + y * y, 1e-20)
    return np.clip(along, 1e-6, 1), (x * x - y * y) / across, weight / weight.sum(axis=1, keepdims=True)
