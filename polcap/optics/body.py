"""Light that leaves a rough body: through visible GGX facets, each a smooth Fresnel interface.

Below the surface light is unpolarized. The camera at zenith θ sees the distribution of visible normals m about the
ray v, so S0 ∝ ⟨T₊(v·m)⟩ and, along the projected normal, S1 ∝ ⟨T₋(v·m) cos 2φ_m⟩ with φ_m the facet's azimuth about
the ray. Facets count evenly where light spreads farther inside the body than a facet is wide (`local` 0), or by the
flash light that falls into them, (v·m) T₊(v·m), where it does not (`local` 1). α = 0 is the smooth interface.
Means over facets come from a table that is integrated at first use. Works on NumPy and torch.

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

from polcap.images import Floats
from polcap.optics import fresnel
from polcap.optics.namespace import array_namespace

_COSINES = np.linspace(0, 1, 49)
_ALPHAS = np.linspace(0, 1, 21)
_INDICES = np.linspace(1.3, 1.7, 3)
_AROUND, _ALONG = 48, 96  # facets of the quadrature: azimuths and slopes
_LEAST_COSINE = 1e-4
_GRAZING = 0.1  # cosine below which shading flattens no further
_SEEN = 0.25  # least cosine of the zeniths, up to 75°, at which the shading is fitted


@dataclass(frozen=True)
class Law:
    """How the body of each place polarizes; fields broadcast to its pixels."""

    rough: Any = 0.0  # the body's α by the gloss's: 0 is the smooth interface
    local: Any = 0.0  # 0…1: how far light leaves through the facet it came in by
    kept: Any = 1.0  # factor on S1 and S2: depth, fibers and dust depolarize further

    def at(self, which: Any) -> "Law":
        """The law of some of the places."""
        return Law(*(x if isinstance(x, float) else x[which] for x in (self.rough, self.local, self.kept)))


SMOOTH = Law()


def leaving(c: Any, alpha: Any, ior: Any, local: Any = 0.0) -> tuple[Any, Any]:
    """Mean T₊ of the visible facets, and the part of it that is polarized along the projected normal.

    Parameters
    ----------
    c
        (...,) cosine of the zenith.
    alpha, ior, local
        GGX α 0…1, refractive index and `Law.local`, broadcast with c.
    """
    plus, minus = fresnel.transmission(c, ior)
    more, even, weighed = _looked_up(c, alpha, ior)
    kept = even + local * (weighed - even)
    return plus + more, (plus + more) * kept * minus / plus


def dolp(c: Any, alpha: Any, ior: Any, local: Any = 0.0) -> Any:
    """Degree of linear polarization of body light.

    Parameters
    ----------
    c, alpha, ior, local
        As in `leaving`.
    """
    plus, minus = leaving(c, alpha, ior, local)
    return minus / plus


def flatter(cos_i: Any, cos_o: Any, between: Any, alpha: Any) -> Any:
    """Factor on Lambert's shading of a rough body whose light stays local: 1 where surface or light face the camera.

    Facets that turn towards a light beside the camera brighten the limb: 1 + B(α) sin θᵢ sin θₒ max(0, cos Δφ) /
    (g (1 + g)), g = max(cos θᵢ, cos θₒ), close to Oren & Nayar's form; B is fitted to the facets. Where the flash
    stands at the lens it is 1 + B (1/cos θ − 1). What they call A is 1 here: albedo is what a facing surface shows.

    Parameters
    ----------
    cos_i, cos_o
        (...,) cosines of light and camera against the normal.
    between
        (...,) cosine of the angle between light and camera.
    alpha
        (...,) GGX α 0…1.
    """
    xp = array_namespace(cos_o)
    strength = _between(xp, xp.asarray(_strengths(), dtype=cos_o.dtype, device=device(cos_o)), alpha, _ALPHAS)
    greater = xp.where(cos_i > cos_o, cos_i, cos_o)
    greater = xp.clip(greater, _GRAZING, None)
    return 1 + strength * xp.clip(between - cos_i * cos_o, 0.0, None) / (greater * (1 + greater))


def make_tables() -> None:
    """Make what `leaving` and `flatter` look up: a third of a second that else the first of them to be called takes."""
    _table()
    _strengths()


def _looked_up(c: Any, alpha: Any, ior: Any) -> tuple[Any, Any, Any]:
    """`_table` at any place, trilinear."""
    xp = array_namespace(c)
    table = xp.asarray(_table().reshape(-1, 3), dtype=c.dtype, device=device(c))
    zero = 0 * c
    steps = [_step(xp, zero + x, nodes) for x, nodes in ((ior, _INDICES), (alpha, _ALPHAS), (c, _COSINES))]
    (ni, nf), (ai, af), (ci, cf) = steps
    out: Any = 0.0
    for n, wn in ((ni, 1 - nf), (ni + 1, nf)):
        for a, wa in ((ai, 1 - af), (ai + 1, af)):
            row = (n * len(_ALPHAS) + a) * len(_COSINES) + ci
            weight = wn * wa
            out = out + (weight * (1 - cf))[..., None] * table[row] + (weight * cf)[..., None] * table[row + 1]
    return out[..., 0], out[..., 1], out[..., 2]


def _between(xp: Any, values: Any, x: Any, nodes: Floats) -> Any:
    at, share = _step(xp, x, nodes)
    return values[at] * (1 - share) + values[at + 1] * share


def _step(xp: Any, x: Any, nodes: Floats) -> tuple[Any, Any]:
    """Node before each x and how far it is to the next, 0…1; x is kept within the nodes."""
    place = xp.clip((x - float(nodes[0])) * ((len(nodes) - 1) / float(nodes[-1] - nodes[0])), 0.0, len(nodes) - 1.0)
    at = xp.astype(xp.clip(xp.floor(place), 0.0, len(nodes) - 2.0), xp.int64)
    return at, place - at


@lru_cache(maxsize=1)
def _table() -> Floats:
    """Over index, α and cosine (3, 21, 49, 3): ⟨T₊⟩ − T₊, and the DoLP over the smooth one's, evenly and locally."""
    out = np.zeros((len(_INDICES), len(_ALPHAS), len(_COSINES), 3))
    out[..., 1:] = 1.0
    cosine = np.maximum(_COSINES, _LEAST_COSINE)
    for j, alpha in enumerate(_ALPHAS[1:], start=1):
        c, turned, weight = facets(cosine, float(alpha))
        for i, ior in enumerate(_INDICES):
            plus, minus = fresnel.transmission(c, ior)
            smooth_plus, smooth_minus = fresnel.transmission(cosine, ior)
            mean = (weight * plus).sum(axis=1)
            even = (weight * minus * turned).sum(axis=1) / mean
            weighted = weight * c * plus
            local = (weighted * minus * turned).sum(axis=1) / (weighted * plus).sum(axis=1)
            out[i, j, :, 0] = mean - smooth_plus
            # towards the normal both vanish with sin²θ: the limit of the ratio is the next node's
            ratio = np.stack([even, local], axis=1)[:-1] / (smooth_minus / smooth_plus)[:-1, None]
            out[i, j, :, 1:] = np.concatenate([ratio, 2 * ratio[-1:] - ratio[-2:-1]])
    return out


@lru_cache(maxsize=1)
def _strengths() -> Floats:
    """B of `flatter` at each α (21,), index 1.5, least squares over zeniths up to 75°."""
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
    """Visible facets of surfaces seen at cosines (N,): v·m, cos 2φ_m and weight (N, M); weights sum to 1.

    In slopes tan θ_m = α √u/(1 − s), u = 1 − (1 − s)², even steps of s and azimuth: a facet's projected area over
    cos θ_m, cos θ + sin θ tan θ_m cos φ, times 1 − s stays finite where slopes do not.
    """
    s, around = np.meshgrid(
        (np.arange(_ALONG) + 0.5) / _ALONG, (np.arange(_AROUND) + 0.5) * np.pi / _AROUND, indexing="ij"
    )
    slope, turn = (alpha * np.sqrt(1 - (1 - s) ** 2) / (1 - s)).ravel(), around.ravel()
    upright = 1 / np.sqrt(1 + slope**2)
    local = np.stack([slope * np.cos(turn), slope * np.sin(turn), np.ones_like(slope)]) * upright  # about the normal
    sine = np.sqrt(1 - cosine**2)
    along = cosine[:, None] * local[2] + sine[:, None] * local[0]  # v·m
    x = sine[:, None] * local[2] - cosine[:, None] * local[0]  # across the ray, towards the projected normal
    y = local[1]
    weight = np.maximum(along, 0) / upright * (1 - s).ravel()
    across = np.maximum(x * x + y * y, 1e-20)
    return np.clip(along, 1e-6, 1), (x * x - y * y) / across, weight / weight.sum(axis=1, keepdims=True)
