"""Polarized shading: Stokes parameters of each pixel from its normal, material and one light.

A dielectric is lit by a point. Diffuse light enters and leaves through two Fresnel transmissions, of a smooth interface
or of rough facets (`optics/body.py`). GGX facets reflect light with Fresnel's coefficients. Shadows and interreflection
are not included: they need the geometry of the whole scene. Works on NumPy and torch.

References
----------
Baek et al., Simultaneous acquisition of polarimetric SVBRDF and normals, SIGGRAPH Asia 2018.
"""

from math import pi
from typing import Any

from polcap.optics import body as bodies
from polcap.optics import brdf, frames, fresnel
from polcap.optics.namespace import array_namespace

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
    axis: Any = None,
) -> Any:
    """Stokes parameters (3, ..., 3) of light reflected towards the camera, in each ray's frame (`optics/frames.py`).

    Parameters
    ----------
    normal, to_light
        (..., 3) unit vectors in the frame of each ray, where (0, 0, 1) points to the camera; see
        `frames.to_ray_frame`.
    diffuse, specular
        (..., 3) ρ_d and F0, linear.
    roughness, ior
        (...,) perceptual roughness; refractive index of the body and its surface.
    irradiance
        (...,) on a plane that faces the light; a white Lambertian plane there has S0 = irradiance.
    law
        Parameters of diffuse reflection.
    axis
        (..., 3) unit vectors along which the light is polarized, across its direction; None: unpolarized.

    Notes
    -----
    Diffuse light is polarized along the projected normal, reflected light across the projected half vector.
    Nine parameters, because training passes each as a tensor of its own.
    """
    xp = array_namespace(normal)
    cos_o = xp.clip(normal[..., 2], _LEAST_COSINE, 1.0)
    cos_i = frames.dot(normal, to_light)
    lit = (cos_i > 0) & (normal[..., 2] > 0)
    cos_i = xp.clip(cos_i, _LEAST_COSINE, 1.0)

    alpha = roughness * roughness
    if law is bodies.SMOOTH:
        in_plus, in_minus = fresnel.transmission(cos_i, ior)
        out_plus, out_minus = fresnel.transmission(cos_o, ior)
    else:
        in_plus, in_minus = bodies.leaving(cos_i, law.rough * alpha, ior, law.local)
        out_plus, out_minus = bodies.leaving(cos_o, law.rough * alpha, ior, law.local)
        in_plus = in_plus * (1 + law.local * (bodies.flattening(cos_i, cos_o, to_light[..., 2], law.rough * alpha) - 1))
        out_minus = out_minus * law.dolp_factor
    if axis is not None:  # Δ from the axis to the plane of normal and light
        in_plus = in_plus + in_minus * (2 * frames.dot(normal, axis) ** 2 / (1 - cos_i**2 + 1e-12) - 1)  # T₋ cos 2Δ
    body = irradiance * cos_i * in_plus

    ray = xp.zeros_like(to_light)
    ray[..., 2] = 1.0
    half = to_light + ray
    half = half / frames.dot(half, half)[..., None] ** 0.5
    cos_h = xp.clip(frames.dot(normal, half), _LEAST_COSINE, 1.0)
    cos_d = xp.clip(half[..., 2], _LEAST_COSINE, 1.0)  # θ_d = ∠(light, half) = ∠(ray, half)
    reflect_plus, reflect_minus = fresnel.reflection(cos_d, ior)
    facets = irradiance * pi * brdf.ggx_distribution(cos_h, alpha) * brdf.smith_masking(cos_i, cos_o, alpha)
    facets = facets / (4 * cos_o) / fresnel.normal_reflectance(ior)  # specular = k_s F0(n)

    diffuse_cos, diffuse_sin = _double_angle(normal)
    half_cos, half_sin = _double_angle(half)
    mirrored = reflect_plus, -reflect_minus * half_cos, -reflect_minus * half_sin
    if axis is not None:
        mirrored = _reflected(to_light, axis, cos_d, ior)
    leaving = out_plus, out_minus * diffuse_cos, out_minus * diffuse_sin
    return xp.stack(
        [
            xp.where(lit[..., None], diffuse * (body * d)[..., None] + specular * (facets * s)[..., None], 0.0)
            for d, s in zip(leaving, mirrored)
        ]
    )


def _reflected(to_light: Any, axis: Any, cos_d: Any, ior: Any) -> tuple[Any, Any, Any]:
    """Stokes parameters (...,) of unit light polarized along `axis` after reflection by a facet, in the ray's frame.

    The field component across the plane of light and ray is multiplied by r_s, the component in that plane by r_p.
    Signs are such that at normal incidence the axis does not change.
    """
    xp = array_namespace(to_light)
    x, y = to_light[..., 0], to_light[..., 1]
    length = (x * x + y * y) ** 0.5
    parallel = length < 1e-9  # light along the ray: any plane contains both
    safe = xp.where(parallel, xp.ones_like(length), length)
    across_x, across_y = xp.where(parallel, 1.0 + 0 * x, -y / safe), xp.where(parallel, 0 * y, x / safe)
    zero = xp.zeros_like(across_x)
    across = xp.stack([across_x, across_y, zero], axis=-1)
    inwards = frames.cross(-to_light, across)
    r_s, r_p = fresnel.amplitudes(cos_d, ior)
    s, p = r_s * frames.dot(axis, across), r_p * frames.dot(axis, inwards)
    field_x, field_y = s * across_x - p * across_y, s * across_y + p * across_x  # p leaves along ray × across
    return field_x**2 + field_y**2, field_x**2 - field_y**2, 2 * field_x * field_y


def _double_angle(vector: Any) -> tuple[Any, Any]:
    """cos 2φ and sin 2φ (...,) of the azimuth φ of vectors (..., 3); 0 for vectors along the ray, without azimuth."""
    x, y = vector[..., 0], vector[..., 1]
    length2 = x * x + y * y + 1e-12
    return (x * x - y * y) / length2, 2 * x * y / length2
