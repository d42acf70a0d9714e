"""Stage 4: segmentation of the object in the picture, with the expected error of its mask.

1. A network gives each pixel a probability of being the object (`network`, with the input of `mask_channels`).
2. Pixels of high probability become a mask without specks (`likely_regions`).
3. The outline is moved to edges of color, where the probabilities allow it (`graph_cut`).
4. For silhouettes, bright parts that the mask lacks are added (`bright_parts`).
5. The pixels on the outline are decided by their coverage (`mask_border`).

Without a network, or if it finds nothing, the object is found by its difference from the `backdrop`. Of a mask drawn by
the user only the part is chosen (`mask.part`).
"""

import contextlib
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.chart_values import ColorCalibration
from polcap.errors import ObjectError
from polcap.image_values import Bits, Bools, Floats, Quality
from polcap.optics.warp import warp
from polcap.stage_values import Alignment, AngleStack, Network, ObjectMask, RunNetwork
from polcap.stages import stage
from polcap.stages.mask import backdrop, bright_parts, graph_cut, likely_regions, mask_border
from polcap.stages.mask.network import object_probability


class MaskSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `mask`, the section `mask` of a settings file."""

    margin: Annotated[
        float, Meta(ge=0, le=1, description="border added around the object's box [share of its longer side]")
    ] = 0.04
    min_area: Annotated[float, Meta(gt=0, le=1, description="least share of the picture that an object covers")] = 0.002
    part: Annotated[int, Meta(ge=0, le=9, description="process this part of the mask, 1 being the largest; 0: all")] = 0
    chart_margin: Annotated[
        float,
        Meta(ge=0, le=2, description="border around the chart without object, if there is no network [patch widths]"),
    ] = 0.7
    silhouette: Annotated[
        Literal["board", "always", "never"],
        Meta(
            description="when to add thin bright parts to the mask, which needs a dark backdrop; "
            "board: only where polcap fuse has erased the board"
        ),
    ] = "board"


@stage(version=11)
def segment(
    radiance: AngleStack,
    alignment: Alignment,
    color: ColorCalibration,
    user_mask: Bools | None,
    network: Network | None,
    run: RunNetwork,
    settings: MaskSettings,
) -> ObjectMask:
    """Segment the object: its mask (H, W) in the reference shot, and a crop around it.

    `user_mask` (H, W) replaces the search. Without a network the object is found by its difference from the backdrop.

    Raises ObjectError: no object is found, or the user's mask is empty or has another size.
    """
    if user_mask is not None:
        height, width = radiance.value.shape[1:3]
        if user_mask.shape != (height, width):
            raise ObjectError(
                f"the mask has {user_mask.shape[1]}×{user_mask.shape[0]} px, the picture {width}×{height}; "
                "draw it on the RAW picture, or on a picture of this size"
            )
        if not user_mask.any():
            raise ObjectError("the mask is empty: no pixel is 128 or brighter; paint the object white")
        return _object(user_mask, "user", None, settings)
    picture, zone = mean_picture(radiance, alignment, color), _chart_zone(radiance, color, settings.chart_margin)
    if network is None:
        mask, doubt = backdrop.find_object(picture, zone, settings.min_area), None
    else:
        patches = _chart_zone(radiance, color, 0.0)
        probability = object_probability(radiance, alignment, color, patches, network, run)
        mask = _by_probability(picture, probability, zone, patches, settings.min_area)
        doubt = likely_regions.expected_error_by_color(picture, mask, probability, patches)
    erased = np.any((radiance.quality & int(Quality.ERASED)) > 0, axis=0)
    if settings.silhouette == "always" or (settings.silhouette == "board" and erased.any()):
        mask = bright_parts.add(picture, mask, erased)
    return _object(mask_border.refine(picture, mask), "automatic", doubt, settings)


def _by_probability(picture: Floats, probability: Floats, zone: Bits, patches: Bits, min_area: float) -> Bools:
    """Mask (H, W) from the network's probability (H, W), or from the backdrop where the network finds nothing.

    `zone` and `patches` (H, W) are 1 on the chart with and without a margin.

    Raises ObjectError: the mask covers a smaller share of the picture than `min_area`.
    """
    mask = likely_regions.likely_regions(probability)
    if mask.any():
        by_color = likely_regions.clean(graph_cut.sharpen(picture, mask, patches, probability), probability)
        mask = likely_regions.choose(by_color, mask, probability)
    else:
        with contextlib.suppress(ObjectError):
            mask = backdrop.find_object(picture, zone, min_area)
    if mask.mean() < min_area:
        raise ObjectError(
            f"no object found: the mask covers {100 * mask.mean():.2f} % of the picture, less than "
            f"mask.min_area = {100 * min_area:g} %; show the object larger, or draw a mask (--mask PNG)"
        )
    return mask


def _object(
    mask: Bools, source: Literal["automatic", "user"], doubt: float | None, settings: MaskSettings
) -> ObjectMask:
    """The mask or its part `settings.part`, with crop and figures. Raises ObjectError: too few parts."""
    if settings.part:
        mask = likely_regions.nth_part(mask, settings.part)
    crop = likely_regions.box_around(mask, settings.margin, least=4)
    if crop is None:
        raise ObjectError(f"the mask has fewer than mask.part = {settings.part} parts; choose a smaller number")
    return ObjectMask(mask, crop, source, doubt, *likely_regions.measure_shape(mask))


def mean_picture(radiance: AngleStack, alignment: Alignment, color: ColorCalibration) -> Floats:
    """Mean picture (H, W, 3) of the registered shots in linear Rec.709, on the scale of S0."""
    total = sum(warp(radiance.value[k], alignment.transform[k], order=1) for k in range(len(radiance.angle)))
    return np.asarray(cv2.transform(total, 2 / len(radiance.angle) * color.matrix), np.float32)


def _chart_zone(radiance: AngleStack, color: ColorCalibration, margin: float) -> Bits:
    """Zone (H, W) of the chart, where the object cannot be: 1 inside, 0 outside.

    The zone's corners are those of the chart's patches, moved outward by `margin` patch widths.
    """
    zone = np.zeros(radiance.value.shape[1:3], np.uint8)
    if color.place is not None:
        corners = np.asarray(color.place.corners, np.float64)
        patch = np.linalg.norm(corners[1] - corners[0]) / 6
        outward = corners - corners.mean(0)
        grown = corners + margin * patch * outward / np.linalg.norm(outward, axis=1, keepdims=True)
        cv2.fillConvexPoly(zone, np.round(grown).astype(np.int32), 1)
    return zone
