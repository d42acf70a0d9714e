"""Textures of the atlas from all views: visible texels of each view, their weights, and robust means.

A view counts more where it sees the surface squarely, where its maps expect small errors, and far from the
object's outline and from edges of parts that hide others. Weights fade to 0 there, so that no seam shows.

Every picture is split into a smooth and a fine band. The smooth band is a mean over all views. The fine band comes
from the best views: a mean of views whose poses err by a pixel would blur it. Normals are baked as differences from
the mesh's own normals, so the mesh counts as one more view.

References
----------
Baumberg, Blending images for texturing 3D models, BMVC 2002 (two frequency bands).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.fusion.atlas import Atlas
from polcap.fusion.small_views import sample
from polcap.fusion.values import FusionView
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.optics.mesh_tracer import Tracer
from polcap.optics.morphology import masked_mean
from polcap.optics.outline import fill_outward
from polcap.optics.projection import project
from polcap.stages import stage

_LEAST_COSINE = 0.15  # between surface and view: beyond 81° a map pixel covers seven texels
_FADE = 0.04  # of the object's diameter: distance from an edge over which a view's weight rises to 1
_EDGE = 8.0  # depth step between neighboring pixels that counts as an edge, in widths of a pixel; a slope of 83° has it
_BEHIND = 3.0  # distance behind the traced surface at which a texel is hidden, in widths of a pixel over the cosine
_SHARPNESS = 4  # power of the weights for the fine band
_OUTLIER_DEG = 12.0  # scale of the Cauchy weights of normals
_OUTLIER = 0.15  # the same of albedo, and of F0 with roughness, over the median of all samples
_FLOOR_DEG = 2.0  # error of every normal, added to the expected one
_ROUNDS = 3  # of reweighting
_SEEN = 0.02  # least total weight of a seen texel; that of a view along the normal, far from any edge, is 1
_MARGIN_PX = 2  # width of the border around the charts that belongs to the mask
# columns of a texel's values (N, 11)
_NORMAL, DIFFUSE, SPECULAR, ROUGHNESS, WEIGHT = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10
MATERIAL = slice(3, 10)


class BakingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `baking` of the fusion."""

    mesh_sigma_deg: Annotated[
        float,
        Meta(
            ge=0, le=90, description="error of the mesh normals; 0: twice their median angle to the views' normals [°]"
        ),
    ] = 0.0
    smooth: Annotated[
        float,
        Meta(gt=0, le=0.5, description="1σ of the Gaussian that separates coarse and fine detail [object's diameter]"),
    ] = 0.03


@dataclass(frozen=True)
class AtlasMaps:
    """Appearance of the object on the texels of its atlas."""

    normal: Floats  # (S, S, 3) unit, board frame
    diffuse: Floats  # (S, S, 3) albedo, linear Rec.709
    specular: Floats  # (S, S, 3) F0
    roughness: Floats  # (S, S) perceptual
    mask: Bools  # (S, S) the charts, with a margin
    weight: Floats  # (S, S) total weight of the views; 1: one view along the normal, far from any edge
    albedo_sigma: float | None = None  # relative 1σ of the scale of all albedos; None: unknown
    detail: Floats | None = None  # as `SurfaceMaps` has; an atlas has none

    @property
    def seen(self) -> Bools:
        """Texels (S, S) that a view saw."""
        return np.asarray(self.weight > _SEEN)

    def texels(self, covered: Bools) -> Floats:
        """Values (N, 11) of the covered texels: normal, diffuse, specular, roughness, weight."""
        parts = (self.normal, self.diffuse, self.specular, self.roughness, self.weight)
        return np.concatenate([part[covered].reshape(np.count_nonzero(covered), -1) for part in parts], axis=-1)


@dataclass(frozen=True)
class VisibleTexels:
    """The M texels that one view sees, with their weights."""

    texel: NDArray[np.intp]  # (M,) index among the atlas's N texels
    pixel: Floats  # (M, 2) x, y in the view's maps
    cosine: Floats  # (M,) between the mesh's normal and the view
    weight: Floats  # (M,) 0…1, without the errors of the maps
    mesh_normal: Floats  # (H, W, 3) of the mesh at the view's pixels, camera frame; 0 without a mesh there

    def sample(self, image: Floats) -> Floats:
        """Values (M,) or (M, C) of an image (H, W) or (H, W, C) of the view, interpolated linearly."""
        return sample(np.ascontiguousarray(image, np.float32), self.pixel, cv2.BORDER_CONSTANT)


@stage(version=4)
def bake(views: tuple[FusionView, ...], atlas: Atlas, settings: BakingSettings) -> AtlasMaps:
    """Bake the maps of all views into the atlas; where no view sees the surface, they are 0."""
    visible = visible_texels(views, atlas)
    count = len(atlas.position)
    normal = _bake_normals(views, visible, atlas, settings)
    albedo = _bake_albedo(views, visible, count, settings.smooth)
    gloss = [texels.sample(np.dstack([view.specular, view.roughness])) for texels, view in zip(visible, views)]
    weights = [texels.weight for texels in visible]
    specular_roughness, _ = _robust_mean(gloss, weights, visible, count, _OUTLIER * _median_length(gloss))
    total = np.zeros(count)
    for texels in visible:
        total[texels.texel] += texels.weight
    values = np.concatenate([normal, albedo, specular_roughness, total[:, None]], axis=-1, dtype=np.float32)
    return on_atlas(atlas, values)


def on_atlas(atlas: Atlas, values: Floats) -> AtlasMaps:
    """Maps from the values (N, 11) of an atlas's texels.

    Texels between the charts get the values of the nearest covered texel. Reduced textures need them, and so do charts
    so small that they cover no texel's middle.
    """
    image = np.zeros((*atlas.covered.shape, 11), np.float32)
    image[atlas.covered] = values
    size = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
    mask = cv2.dilate(atlas.covered.astype(np.uint8), size) > 0
    image = fill_outward(image, atlas.covered)
    normal, diffuse, specular, roughness = (
        np.ascontiguousarray(image[..., part]) for part in (_NORMAL, DIFFUSE, SPECULAR, ROUGHNESS)
    )
    return AtlasMaps(normal, diffuse, specular, roughness, mask, np.where(mask, image[..., WEIGHT], 0))


def visible_texels(views: Sequence[FusionView], atlas: Atlas) -> list[VisibleTexels]:
    """The texels that each view sees."""
    tracer = atlas.tracer()
    return [_visible(view, atlas, tracer) for view in views]


def _visible(view: FusionView, atlas: Atlas, tracer: Tracer) -> VisibleTexels:
    """The texels that face the view, in front of the rest of the mesh and inside the picture."""
    height, width = view.mask.shape
    surface = tracer.trace(view.pose.rotation, view.pose.translation, view.camera, height, width)
    point = view.pose.to_camera(atlas.position)
    cosine = frames.dot(atlas.normal @ view.pose.rotation.T, frames.unit(-point))
    pixel = project(view.camera, point)
    column, row = np.rint(pixel).astype(int).T
    inside = (cosine > _LEAST_COSINE) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    texel = np.flatnonzero(inside & (point[:, 2] < 0))
    row, column, cosine = row[texel], column[texel], cosine[texel]
    slack = _BEHIND / view.camera.focal / cosine
    in_front = -point[texel, 2] <= surface.depth[row, column] * (1 + slack)  # false where the surface is missed
    fade = _fade_at_edges(view, surface.depth)[row, column]
    weight = np.where(in_front, cosine**2 * fade, 0)
    seen = np.flatnonzero(weight > 0)
    texel = texel[seen]
    return VisibleTexels(
        texel=texel,
        pixel=pixel[texel].astype(np.float32),
        cosine=cosine[seen].astype(np.float32),
        weight=weight[seen].astype(np.float32),
        mesh_normal=surface.normal,
    )


def _fade_at_edges(view: FusionView, depth: Floats) -> Floats:
    """Weight (H, W) that rises smoothly to 1 from 0 at the outline and at edges of parts that hide others."""
    edge_step = _EDGE / view.camera.focal * np.where(np.isfinite(depth), depth, 0)
    filled = np.where(np.isfinite(depth), depth, np.inf)
    inside = view.mask & np.isfinite(depth)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            jump = np.abs(np.diff(filled, axis=axis)) > edge_step.take(range(depth.shape[axis] - 1), axis)
            pad = [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)]
            inside &= ~(np.pad(jump, pad) | np.pad(jump, [side[::-1] for side in pad]))  # both pixels of a jump
    distance = cv2.distanceTransform(np.pad(inside, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
    share = np.clip(distance / (_FADE * diameter_px(view)), 0, 1)
    return np.asarray(share * share * (3 - 2 * share))  # smoothstep


def diameter_px(view: FusionView) -> float:
    """Diameter of the object in a view, px: that of a disk with the mask's area."""
    return float(np.sqrt(4 * max(int(view.mask.sum()), 1) / np.pi))


def _bake_normals(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], atlas: Atlas, settings: BakingSettings
) -> Floats:
    """Unit normals (N, 3) in the board frame: those of the mesh plus the mean differences of the views from it."""
    smooth, fine, weights = list[Floats](), list[Floats](), list[Floats]()
    for view, texels in zip(views, visible):
        both = view.mask & (frames.dot(texels.mesh_normal, texels.mesh_normal) > 0.5)  # view and mesh have a normal
        difference = np.where(both[..., None], view.normal - texels.mesh_normal, 0).astype(np.float32)
        low, high = _sample_bands(difference, both, texels, settings.smooth * diameter_px(view))
        smooth.append(low @ view.pose.rotation)
        fine.append(high @ view.pose.rotation)
        weights.append(texels.weight / (texels.sample(view.sigma_deg) ** 2 + _FLOOR_DEG**2))
    prior = (settings.mesh_sigma_deg or _mesh_sigma_deg(smooth)) ** -2  # weight of the mesh: a difference of 0
    outlier = float(np.radians(_OUTLIER_DEG))
    means = _mean_bands(smooth, fine, weights, visible, len(atlas.position), outlier, prior)
    return frames.unit(atlas.normal + means[0] + means[1])


def _mesh_sigma_deg(differences: Sequence[Floats]) -> float:
    """Error of the mesh's smooth normals: twice the median angle between them and those of the views.

    Twice, because the mesh was fitted to these normals; docs/benchmarks/fusion-choices.md.
    """
    angle = np.concatenate([np.linalg.norm(one[::8], axis=-1) for one in differences])  # rad, by the chord
    return float(max(2 * np.degrees(np.median(angle)), _FLOOR_DEG))


def _bake_albedo(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], count: int, smooth_share: float
) -> Floats:
    """Albedo (N, 3) of the texels."""
    bands = [
        _sample_bands(view.diffuse, view.mask, texels, smooth_share * diameter_px(view))
        for texels, view in zip(visible, views)
    ]
    smooth, fine = zip(*bands)
    weights = [texels.weight for texels in visible]
    means = _mean_bands(smooth, fine, weights, visible, count, _OUTLIER * _median_length(smooth))
    return np.maximum(means[0] + means[1], 0)


def _median_length(samples: Sequence[Floats]) -> float:
    """Median length of the samples (M, C) of all views, by every 16th."""
    return float(np.median(np.concatenate([np.linalg.norm(one[::16], axis=-1) for one in samples])))


def _sample_bands(image: Floats, inside: Bools, texels: VisibleTexels, sigma_px: float) -> tuple[Floats, Floats]:
    """Smooth and fine band (M, 3) of an image (H, W, 3) inside a mask, at the visible texels."""
    smooth = masked_mean(image, inside, sigma_px)
    fine = np.where(inside[..., None], image.astype(np.float32) - smooth, 0)
    both = texels.sample(np.concatenate([smooth, fine], axis=-1))  # in one: OpenCV rounds by the number of channels
    return both[:, :3], both[:, 3:]


def _mean_bands(
    smooth: Sequence[Floats],
    fine: Sequence[Floats],
    weights: Sequence[Floats],
    visible: Sequence[VisibleTexels],
    count: int,
    outlier: float,
    prior: float = 0.0,
) -> tuple[Floats, Floats]:
    """Mean (N, 3) of all smooth bands by `_robust_mean`, and mean (N, 3) of the fine bands of the best views."""
    mean, weights = _robust_mean(smooth, weights, visible, count, outlier, prior)
    return mean, _weighted_mean(fine, [one**_SHARPNESS for one in weights], visible, count)


def _robust_mean(
    samples: Sequence[Floats],
    weights: Sequence[Floats],
    visible: Sequence[VisibleTexels],
    count: int,
    outlier: float,
    prior: float = 0.0,
) -> tuple[Floats, list[Floats]]:
    """Mean (N, C) of samples with Cauchy's weights of the scale `outlier`, and these weights.

    `prior` is the weight of a further sample of value 0.
    """
    robust = list(weights)
    for _ in range(_ROUNDS):
        mean = _weighted_mean(samples, robust, visible, count, prior)
        robust = [
            weight / (1 + np.sum((value - mean[texels.texel]) ** 2, axis=-1) / outlier**2)
            for value, weight, texels in zip(samples, weights, visible)
        ]
    return _weighted_mean(samples, robust, visible, count, prior), robust


def _weighted_mean(
    samples: Sequence[Floats],
    weights: Sequence[Floats],
    visible: Sequence[VisibleTexels],
    count: int,
    prior: float = 0.0,
) -> Floats:
    """Weighted mean (N, C) over the views, 0 where none has weight."""
    total, mean = np.full(count, prior), np.zeros((count, samples[0].shape[-1]))
    for value, weight, texels in zip(samples, weights, visible):
        total[texels.texel] += weight
        mean[texels.texel] += weight[:, None] * value
    return np.asarray(mean / np.maximum(total, 1e-30)[:, None])
