"""Renderer of synthetic scenes: Stokes parameters and surface geometry at any pixel positions.

Every shot is rendered on its own pixels, so nothing is resampled. Camera frame of `optics/frames.py`, metres, the lens
at the origin. Radiance is linear Rec.709.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType, structs
from scipy.ndimage import minimum_filter
from scipy.spatial.transform import Rotation

from polcap.errors import SettingError
from polcap.image_values import Floats, Indices, View
from polcap.optics import body, frames, fresnel, mesh_tracer, shade
from polcap.optics.mesh_tracer import GBuffer
from polcap.synth import color_checker as charts
from polcap.synth import interreflection, laid_board, scene_materials, trace
from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Model, Shape
from polcap.synth.laid_board import LaidBoard
from polcap.synth.scene_materials import Coat
from polcap.synth.trace import Hits, Vector

_ROUGH = body.Law(rough=1.0)  # facets with the roughness of the gloss, all with the same weight


class Scene(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An object, a chart and a board under a flash, in front of a dark backdrop.

    truth.json has all fields but the unset ones, so that a new field does not change the files of old scenes.
    """

    shape: Shape | Model
    coat: Coat
    position: Vector = (-0.065, 0.0, -0.70)  # m, of the object's origin
    turn_deg: Vector = (0.0, 0.0, 0.0)  # rotation vector of the object
    light: Vector = (0.0, 0.05, 0.0)  # m, of the flash
    chart: Chart | None = Chart()
    backdrop: float = 1.3  # m, distance from the lens
    backdrop_albedo: float = 0.03
    shadows: bool = True  # of the object on itself
    cast_shadows: bool | UnsetType = UNSET  # of the object on chart, board and backdrop
    interreflection: bool | UnsetType = UNSET  # one diffuse bounce between parts of the object; meshes only
    law: Literal["smooth", "rough"] | UnsetType = UNSET  # surface model of the diffuse reflection; unset: smooth
    board: LaidBoard | UnsetType = UNSET  # under the object

    @property
    def turn(self) -> Rotation:
        return Rotation.from_rotvec(self.turn_deg, degrees=True)


def stokes(
    scene: Scene, view: View, x: Floats, y: Floats, start: Floats | None = None, flash_axis: float | None = None
) -> Floats:
    """Stokes parameters (3, H, W, 3) at pixel positions x, y (H, W) of `view`, in the frame of each ray.

    A white matt plane at the object's distance that faces the flash has S0 = 1. `start` comes from `guide`.
    The flash is polarized along `flash_axis` [rad, in the picture], or unpolarized with the same brightness.
    """
    v = frames.rays_at(view, x, y).reshape(-1, 3)
    if start is not None:
        row = np.clip(np.rint(y), 0, start.shape[0] - 1).astype(np.intp)
        column = np.clip(np.rint(x), 0, start.shape[1] - 1).astype(np.intp)
        start = start[row, column].ravel()
    hits, surroundings = _visible(scene, v, start)
    out = surroundings.astype(np.float32)
    out[:, hits.index] = _shade(scene, v[hits.index], hits, flash_axis)
    return out.reshape(3, *x.shape, 3)


@dataclass(frozen=True)
class ObjectBuffer(GBuffer):
    """G-buffer of an object with relief: `normal` includes the relief, `facing` does not."""

    facing: Floats  # (H, W, 3) unit, normals without relief, object's own frame; 0 outside


def gbuffer(scene: Scene, view: View, height: int, width: int) -> ObjectBuffer:
    """G-buffer of a scene's object at the center of each pixel."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    unlit = structs.replace(scene, cast_shadows=False)  # the light on chart, board and backdrop is not needed
    hits, _ = _visible(unlit, frames.rays_at(view, x, y).reshape(-1, 3))
    facing, bent = _normals(scene, hits)
    depth = mesh_tracer.scatter(-hits.point[:, 2], hits.index, x.shape, np.nan)
    normal, position, facing = (mesh_tracer.scatter(a, hits.index, x.shape) for a in (bent, hits.local, facing))
    return ObjectBuffer(normal, depth, np.isfinite(depth), position, view, facing)


def guide(buffer: GBuffer) -> Floats:
    """Distance (H, W) [m], in front of the surface, at which rays near each pixel may start; infinite: no object."""
    height, width = buffer.mask.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    distance = buffer.depth / frames.rays_at(buffer.view, x, y)[..., 2]
    return np.asarray(minimum_filter(np.where(buffer.mask, distance, np.inf), 5))  # within 2 px


def white_level(scene: Scene) -> float:
    """S0 of an ideal white surface at the chart's white patch; 1 without a chart."""
    if scene.chart is None:
        return 1.0
    point = charts.patches(scene.chart)[18].mean(axis=0, keepdims=True)  # the white patch
    return float(_irradiance(scene, point, scene.chart.axes[0])[0])


def _visible(scene: Scene, v: Floats, start: Floats | None = None) -> tuple[Hits, Floats]:
    """Visible hits of rays on the object, and Stokes parameters (3, P, 3) of the chart, board and backdrop behind."""
    distance = scene.backdrop / v[:, 2]
    wall = scene.backdrop_albedo * _unshadowed_irradiance(scene, -v * distance[:, None], np.array([0.0, 0.0, 1.0]))
    out = np.zeros((3, len(v), 3))
    out[0] = wall[:, None]
    hits = trace.trace(scene.shape, scene.position, scene.turn, v, start)
    for normal, roughness, (at, reach, albedo) in _flat_objects(scene, v):
        nearer = reach < distance[at]
        at, reach, albedo = at[nearer], reach[nearer], albedo[nearer]
        distance[at] = reach
        point = -v[at] * reach[:, None]
        out[:, at] = _highlight(scene, v[at], point, normal, roughness) if roughness else 0.0
        out[0, at] += albedo * _unshadowed_irradiance(scene, point, normal)[:, None]
    return hits.take(np.flatnonzero(hits.distance < distance[hits.index])), out


def _flat_objects(scene: Scene, v: Floats) -> Iterator[tuple[Floats, float, tuple[Indices, Floats, Floats]]]:
    """Normals and roughness (0: matt) of chart and board, and the rays on them: indices, lengths [m] and albedo."""
    if scene.chart is not None:
        yield scene.chart.axes[0], 0.0, charts.intersect(scene.chart, v)
    if scene.board is not UNSET:
        yield scene.board.normal, scene.board.roughness or 0.0, laid_board.intersect(scene.board, v)


def _highlight(scene: Scene, ray: Floats, point: Floats, normal: Floats, roughness: float) -> Floats:
    """Stokes parameters (3, N, 3) of the flash's reflection by a glossy board at points (N, 3)."""
    to_light = frames.unit(np.array(scene.light) - point)
    irradiance, dark = _unshadowed_irradiance(scene, point, to_light), np.zeros((len(point), 3))
    facing = frames.to_ray_frame(np.broadcast_to(normal, point.shape), ray)
    gloss, ior = (np.full(len(point), value) for value in (roughness, laid_board.IOR))
    light = frames.to_ray_frame(to_light, ray)
    return np.asarray(shade.stokes(facing, dark, dark + laid_board.F0, gloss, ior, light, irradiance))


def _unshadowed_irradiance(scene: Scene, point: Floats, normal: Floats) -> Floats:
    """Irradiance (N,) by the flash as of `_irradiance`, but 0 in the object's cast shadow if the scene has any."""
    light = _irradiance(scene, point, normal)
    if scene.cast_shadows:
        light[trace.in_shadow(scene.shape, scene.position, scene.turn, point, scene.light)] = 0.0
    return light


def _irradiance(scene: Scene, point: Floats, normal: Floats) -> Floats:
    """Irradiance (N,) by the flash at points (N, 3) with `normal`; 1 facing the flash at the object's distance."""
    to_light = np.array(scene.light) - point
    squared = np.einsum("ni,ni->n", to_light, to_light)
    reference = np.sum((np.array(scene.light) - np.array(scene.position)) ** 2)
    cosine = np.einsum("ni,ni->n", to_light, np.broadcast_to(normal, point.shape)) / np.sqrt(squared)
    return np.asarray(np.maximum(cosine, 0.0) * reference / squared)


def _shade(scene: Scene, ray: Floats, hits: Hits, flash_axis: float | None = None) -> Floats:
    """Stokes parameters (3, N, 3) of the light that the object reflects towards the lens."""
    to_light = np.array(scene.light) - hits.point
    to_light /= np.linalg.norm(to_light, axis=-1, keepdims=True)
    irradiance = _irradiance(scene, hits.point, to_light)
    if scene.shadows:
        lit = np.flatnonzero(np.einsum("ni,ni->n", hits.normal, to_light) > 0)
        lifted = hits.point[lit] + trace.LIFT * hits.normal[lit]
        hidden = trace.in_shadow(scene.shape, scene.position, scene.turn, lifted, scene.light)
        irradiance[lit[hidden]] = 0.0
    facing, bent = _normals(scene, hits)
    diffuse, specular, roughness, ior = scene_materials.evaluate(scene.coat, hits.local, facing)
    normal, light = frames.to_ray_frame(bent, ray), frames.to_ray_frame(to_light, ray)
    law = _ROUGH if scene.law == "rough" else body.SMOOTH
    axis = None
    if flash_axis is not None:
        wanted = np.array([np.cos(flash_axis), np.sin(flash_axis), 0.0])
        across = wanted - to_light * (to_light @ wanted)[:, None]
        axis = frames.to_ray_frame(across / np.linalg.norm(across, axis=-1, keepdims=True), ray)
    direct = shade.stokes(normal, diffuse, specular, roughness, ior, light, irradiance, law, axis)
    if not scene.interreflection:
        return np.asarray(direct)
    bounced = np.einsum("nkc,nk->nc", _bounced(scene)[hits.face], hits.weight)
    entered, _ = fresnel.transmission(1.0, ior)  # `bounced` already includes it
    once = shade.stokes(normal, diffuse * bounced, 0 * specular, roughness, ior, normal, 1 / entered, law)
    return np.asarray(direct + once)


def _normals(scene: Scene, hits: Hits) -> tuple[Floats, Floats]:
    """Surface normals (N, 3) at hits: without relief, in the object's frame; with relief, in the camera's frame."""
    facing = scene.turn.inv().apply(hits.normal)
    bent = scene_materials.add_relief(scene.coat, hits.local, facing)
    if bent is facing:
        return facing, hits.normal
    return facing, mesh_tracer.face_camera(scene.turn.apply(bent), -hits.point / hits.distance[:, None])


@lru_cache(maxsize=2)
def _bounced(scene: Scene) -> Floats:
    """Interreflected light (F, 3, 3) at the three corners of each face of the scene's mesh."""
    if not isinstance(scene.shape, Model):
        raise SettingError("interreflection needs triangles; give the object as a mesh")
    tracer = trace.model_tracer(scene.shape)
    flash, lens = (scene.turn.inv().apply(np.array(at) - scene.position) for at in (scene.light, (0.0, 0.0, 0.0)))

    def lit(point: Floats, normal: Floats, towards: Floats) -> Floats:
        diffuse, _, _, ior = scene_materials.evaluate(scene.coat, point, normal)
        light = interreflection.flash_light(tracer, point, normal, flash, float(flash @ flash))
        return interreflection.diffuse_light(light, normal, towards, diffuse, ior)

    ior = scene.coat.materials[0].ior
    return np.asarray(interreflection.gather(tracer, lit, lens, ior)[tracer.mesh.faces])
