"""Compares each view with the fused object: its normals with the mesh's, its photograph with a rendering."""

from dataclasses import dataclass

import numpy as np

from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, VisibleTexels, visible_texels
from polcap.fusion.values import IOR, FusionView
from polcap.image_values import Floats
from polcap.optics import frames, shade
from polcap.optics.point_light import irradiance
from polcap.stages import stage


@dataclass(frozen=True)
class ViewAgreement:
    """Agreement of one view with the fused object."""

    name: str
    normal_deg: float  # median angle between the view's normals and the mesh's
    residual: float | None  # rms of photograph minus rendering over the photograph's rms; None without S0


@dataclass(frozen=True)
class Comparison:
    """Agreement of all views with the fused object."""

    views: tuple[ViewAgreement, ...]


@stage(version=2)
def compare(views: tuple[FusionView, ...], atlas: Atlas, maps: AtlasMaps) -> Comparison:
    """Compare each view with the fused mesh and its textures."""
    visible = visible_texels(views, atlas)
    return Comparison(tuple(_agreement(view, texels, atlas, maps) for view, texels in zip(views, visible)))


def _agreement(view: FusionView, visible: VisibleTexels, atlas: Atlas, maps: AtlasMaps) -> ViewAgreement:
    """Agreement of one view, where both it and the mesh have a normal; 90° if they have none in common."""
    both = view.mask & (frames.dot(visible.mesh_normal, visible.mesh_normal) > 0.5)
    angle_deg = float(np.median(frames.angle_deg(view.normal, visible.mesh_normal)[both])) if both.any() else 90.0
    if view.s0 is None or not len(visible.texel):
        return ViewAgreement(view.name, angle_deg, None)
    photograph, drawn = visible.sample(view.s0), render(view, visible, atlas, maps)
    weight = visible.weight[:, None]
    # the brightness that fits best
    drawn = drawn * float((weight * drawn * photograph).sum() / max((weight * drawn * drawn).sum(), 1e-12))
    error = (weight * (photograph - drawn) ** 2).sum() / max((weight * photograph**2).sum(), 1e-12)
    return ViewAgreement(view.name, angle_deg, float(np.sqrt(error)))


def render(view: FusionView, visible: VisibleTexels, atlas: Atlas, maps: AtlasMaps) -> Floats:
    """S0 (M, 3) of the texels that a view sees under a flash at the lens; 1: white plane at the object's distance."""
    rotation, translation = view.pose.rotation, view.pose.translation
    point = view.pose.to_camera(atlas.position[visible.texel])
    to_lens = frames.unit(-point)
    normal, diffuse, specular, roughness = (
        part[atlas.covered][visible.texel].astype(np.float64)
        for part in (maps.normal, maps.diffuse, maps.specular, maps.roughness)
    )
    distance = float(np.linalg.norm(rotation @ atlas.position.mean(axis=0) + translation))
    light = irradiance(point, np.zeros(2), 0.0) * distance**2
    to_light = frames.to_ray_frame(to_lens, to_lens)
    local = frames.to_ray_frame(normal @ rotation.T, to_lens)
    one, rough = np.ones(len(point)), np.maximum(roughness, 0.05)
    return np.asarray(shade.stokes(local, diffuse, specular, rough, IOR * one, to_light, light)[0])
