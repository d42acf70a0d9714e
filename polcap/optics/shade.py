"""The one renderer of maps: normals and material under one light -> Stokes parameters of every pixel.

A dielectric lit by an unpolarized point: diffuse light enters and leaves through two Fresnel
transmissions, of a smooth interface or of rough facets (`optics/body.py`), GGX facets reflect with Fresnel's
coefficients. Local: no shadow, no interreflection
(those belong to whoever owns the geometry). Works on NumPy and torch.

References
----------
Baek et al., Simultaneous acquisition of polarimetric SVBRDF and normals, SIGGRAPH Asia 2018.
"""

from math import pi
from typing import Any

from array_api_compat import array_namespace

from polcap.optics import body as bodies
from polcap.optics import brdf, fresnel

_LEAST_COSINE = 1e-4


def stokes(
    normal: Any,
    diffuse: Any,
    specular: Any,
    roughness: Any,
    ior: Any,
    to_light: Any,
    irradiance: Any,
    law: bodies.Law = bodies.SMOOTH,
) -> Any:
    """Stokes parameters (3, ..., 3) towards the camera, in the frame of `optics/frames.py` on each ray.

    Parameters
    ----------
    normal, to_light
        (..., 3) unit vectors in the frame of each ray, where the camera lies along
        (0, 0, 1): see `frames.to_ray_frame`.
    diffuse, specular
        (..., 3) ρ_d and F0, linear.
    roughness, ior
        (...,) perceptual roughness; refractive index of the body and its surface.
    irradiance
        (...,) on a plane facing the light, so that a white Lambertian plane has S0 = irradiance.
    law
        How the body lets light in and out.

    Notes
    -----
    Diffuse light is polarized along the projected normal, reflected light across the projected half vector.
    """
    xp = array_namespace(normal)
    cos_o = xp.clip(normal[..., 2], _LEAST_COSINE, 1.0)
    cos_i = xp.sum(normal * to_light, axis=-1)
    lit = (cos_i > 0) & (normal[..., 2] > 0)
    cos_i = xp.clip(cos_i, _LEAST_COSINE, 1.0)

    alpha = roughness * roughness
    if law is bodies.SMOOTH:
        in_plus, _ = fresnel.transmission(cos_i, ior)
        out_plus, out_minus = fresnel.transmission(cos_o, ior)
    else:
        in_plus, _ = bodies.leaving(cos_i, law.rough * alpha, ior)
        out_plus, out_minus = bodies.leaving(cos_o, law.rough * alpha, ior, law.local)
        in_plus = in_plus * (1 + law.local * (bodies.flatter(cos_i, cos_o, to_light[..., 2], law.rough * alpha) - 1))
        out_minus = out_minus * law.kept
    body = irradiance * cos_i * in_plus

    ray = xp.zeros_like(to_light)
    ray[..., 2] = 1.0
    half = to_light + ray
    half = half / xp.sum(half * half, axis=-1)[..., None] ** 0.5
    cos_h = xp.clip(xp.sum(normal * half, axis=-1), _LEAST_COSINE, 1.0)
    cos_d = xp.clip(half[..., 2], _LEAST_COSINE, 1.0)  # θ_d = ∠(light, half) = ∠(ray, half)
    reflect_plus, reflect_minus = fresnel.reflection(cos_d, ior)
    facets = irradiance * pi * brdf.ggx_distribution(cos_h, alpha) * brdf.smith_masking(cos_i, cos_o, alpha)
    facets = facets / (4 * cos_o) / fresnel.normal_reflectance(ior)  # specular = k_s F0(n)

    diffuse_cos, diffuse_sin = _double_angle(normal)
    half_cos, half_sin = _double_angle(half)
    parts = [
        (out_plus, reflect_plus),
        (out_minus * diffuse_cos, -reflect_minus * half_cos),
        (out_minus * diffuse_sin, -reflect_minus * half_sin),
    ]
    return xp.stack(
        [
            xp.where(lit[..., None], diffuse * (body * d)[..., None] + specular * (facets * s)[..., None], 0.0)
            for d, s in parts
        ]
    )


def _double_angle(vector: Any) -> tuple[Any, Any]:
    """cos 2φ, sin 2φ of the azimuth of (..., 3) vectors; (0, 0) along the ray, where it has no meaning."""
    x, y = vector[..., 0], vector[..., 1]
    length2 = x * x + y * y + 1e-12
    return (x * x - y * y) / length2, 2 * x * y / length2
