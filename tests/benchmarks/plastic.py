"""Shared parts of comparisons with Mitsuba 3: film, camera, polarized plastic, Stokes parameters in polcap's frame."""

from typing import Any

import numpy as np

from polcap.image_values import Floats, View
from polcap.optics import frames


def film(size: int) -> dict[str, Any]:
    """Square, each pixel the mean over its own area."""
    box = {"type": "box"}
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": box, "component_format": "float32"}


def camera(mi: Any, view: View, size: int, sampler: str, samples: int) -> dict[str, Any]:
    """A pinhole at the origin that looks along −z with y up."""
    offset = [((size - 1) / 2 - c) / size for c in view.center]
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(size / 2 / view.focal))),
        "principal_point_offset_x": offset[0],
        "principal_point_offset_y": offset[1],
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, -1], up=[0, 1, 0]),
        "film": film(size),
        "sampler": {"type": sampler, "sample_count": samples},
    }


def plastic(alpha: float, ior: float, diffuse: Any, specular: Any) -> dict[str, Any]:
    """A smooth or rough dielectric over a diffuse body; `specular` is k_s, F0 is k_s ((n − 1)/(n + 1))²."""
    return {
        "type": "pplastic",
        "distribution": "ggx",
        "alpha": alpha,
        "int_ior": ior,
        "ext_ior": 1.0,
        "diffuse_reflectance": diffuse,
        "specular_reflectance": specular,
    }


def in_ray_frame(image: Floats, view: View) -> Floats:
    """S0, S1, S2 … (H, W, ≥3) of `camera` -> (3, H, W) in the frame of each ray.

    Mitsuba's S1, S2 refer to the horizontal across each ray (view × up), polcap's to the projected x axis.
    """
    v = frames.rays(view, *image.shape[:2]).astype(float)
    e_x, e_y = frames.basis(v)
    across = np.cross(-v, [0.0, 1.0, 0.0])
    turn = np.arctan2((across * e_y).sum(-1), (across * e_x).sum(-1))
    linear = (image[..., 1] + 1j * image[..., 2]) * np.exp(2j * turn)
    return np.stack([image[..., 0], linear.real, linear.imag])
