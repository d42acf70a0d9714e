"""Fresnel's equations of a dielectric in air, and the zenith angle of a surface from its DoLP.

c = cos θ with θ the angle in air, n the refractive index, g = √(n² − sin²θ). `plus` is the mean of the s and p
coefficients: the intensity from unpolarized light of intensity 1. `minus` is half their difference: its linearly
polarized part. Works on NumPy and torch.

References
----------
Atkinson & Hancock, Recovery of surface orientation from diffuse polarization, IEEE TIP 2006.
"""

from typing import Any

from polcap.optics.namespace import array_namespace


def transmission(c: Any, ior: Any) -> tuple[Any, Any]:
    """Fresnel transmittances T₊, T₋ = (T_p ± T_s)/2 ≥ 0, equal in both directions; c and ior broadcast."""
    g = _refracted(c, ior)
    n2 = ior * ior
    t_s = 4 * c * g / (c + g) ** 2
    t_p = 4 * n2 * c * g / (n2 * c + g) ** 2
    return (t_p + t_s) / 2, (t_p - t_s) / 2


def reflection(c: Any, ior: Any) -> tuple[Any, Any]:
    """Fresnel reflectances R₊, R₋ = (R_s ± R_p)/2 ≥ 0; c and ior broadcast."""
    r_s, r_p = (amplitude**2 for amplitude in amplitudes(c, ior))
    return (r_s + r_p) / 2, (r_s - r_p) / 2


def amplitudes(c: Any, ior: Any) -> tuple[Any, Any]:
    """Fresnel's amplitude coefficients of reflection r_s, r_p; r_s < 0 < r_p at normal incidence."""
    g = _refracted(c, ior)
    n2 = ior * ior
    return (c - g) / (c + g), (n2 * c - g) / (n2 * c + g)


def normal_reflectance(ior: Any) -> Any:
    """Reflectance at normal incidence, F0 = ((n − 1)/(n + 1))²."""
    return ((ior - 1) / (ior + 1)) ** 2


def greatest_diffuse_dolp(ior: float) -> float:
    """Largest DoLP of diffuse reflection, at θ = 90°: (n² − 1)/(n² + 1)."""
    return (ior**2 - 1) / (ior**2 + 1)


def cos_zenith_from_dolp(dolp: Any, ior: float) -> Any:
    """Cosine (...,) of the zenith angle from the DoLP ρ (...,) T₋/T₊ of diffuse reflection.

    cos θ = (n − S)/√(S((1 + n²)S − 2n)) with S = √((1 + ρ)/(1 − ρ)) and the index n = `ior`. The DoLP is clipped to the
    range of this index.
    """
    xp = array_namespace(dolp)
    rho = xp.clip(dolp, 0.0, greatest_diffuse_dolp(ior) - 1e-6)
    s = xp.sqrt((1 + rho) / (1 - rho))
    return xp.clip((ior - s) / xp.sqrt(s * ((1 + ior * ior) * s - 2 * ior)), 0.0, 1.0)


def _refracted(c: Any, ior: Any) -> Any:
    """The term g = √(n² − sin²θ) = n cos θ_t of Fresnel's equations."""
    return (ior * ior - 1 + c * c) ** 0.5
