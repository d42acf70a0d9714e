"""Stage 4: decide which pixels are the object, and how sure that is.

A small network gives every pixel its chance of being the object (`two_looks`): it was trained on what is hard to
tell apart, such as black gloss on black cloth, white on white and deep shadow. Colors (`standing_out`) then find the
outline, as far as the network agrees. Where it sees nothing, or there is none, the object is what stands out from
the backdrop.
A mask that the user drew is taken as drawn.
"""

import contextlib
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap.errors import ObjectError
from polcap.images import Alignment, AngleStack, ColorCalibration, Floats, Network, ObjectMask, RunNetwork
from polcap.optics.warp import warp
from polcap.stages import stage
from polcap.stages.mask import network as two_looks
from polcap.stages.mask import solid, standing_out


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `mask` of a settings file."""

    margin: Annotated[
        float, Meta(ge=0, le=1, description="border added around the object's box [share of its longer side]")
    ] = 0.04
    min_area: Annotated[float, Meta(gt=0, le=1, description="least part of the picture that an object covers")] = 0.002
    chart_margin: Annotated[
        float,
        Meta(ge=0, le=2, description="border around the chart that is not the object; no network [patch widths]"),
    ] = 0.7


@stage(version=6)
def segment(
    radiance: AngleStack,
    alignment: Alignment,
    color: ColorCalibration,
    user_mask: NDArray[np.bool_] | None,
    network: Network | None,
    run: RunNetwork,
    settings: Settings,
) -> ObjectMask:
    """The object on the sum of the aligned shots, and a crop around it.

    Parameters
    ----------
    radiance
        The shots (K, H, W, 3), each on its own grid.
    alignment
        Where each lies on the reference grid.
    color
        Tells where the chart lies, which is not the object.
    user_mask
        (H, W) on the reference grid; replaces the search.
    network
        Finds the object; None takes for it what stands out from the backdrop.
    settings
        Borders around object and chart, and the least area.

    Raises
    ------
    ObjectError
        Nothing stands out, or the user's mask is empty or of another size.
    """
    if user_mask is not None:
        if user_mask.shape != radiance.value.shape[1:3]:
            raise ObjectError(
                f"mask is {user_mask.shape[1]}×{user_mask.shape[0]} px, the picture's grid "
                f"{radiance.value.shape[2]}×{radiance.value.shape[1]}; draw it on the RAW picture or this grid"
            )
        if not user_mask.any():
            raise ObjectError("mask is empty: no pixel is 128 or brighter; paint the object white")
        return ObjectMask(user_mask, _crop(user_mask, settings.margin), "user", None, None, *solid.shape(user_mask))
    picture, zone = _picture(radiance, alignment, color), _chart_zone(radiance, color, settings.chart_margin)
    if network is None:
        mask = standing_out.search(picture, zone, settings.min_area)
        return ObjectMask(mask, _crop(mask, settings.margin), "automatic", None, None, *solid.shape(mask))
    patches = _chart_zone(radiance, color, 0.0)
    chance = two_looks.chances(radiance, alignment, color, patches, network, run)
    mask = solid.body(chance)
    if mask.any():
        colored = solid.cleaned(standing_out.sharpened(picture, mask, patches, chance), chance)
        mask = solid.preferred(colored, mask, chance)
    else:
        with contextlib.suppress(ObjectError):
            mask = standing_out.search(picture, zone, settings.min_area)
    if mask.mean() < settings.min_area:
        raise ObjectError(
            f"no object is seen: {100 * mask.mean():.2f} % of the picture, less than "
            f"mask.min_area = {100 * settings.min_area:g} %; let the object fill more of it, or give --mask PNG"
        )
    return ObjectMask(
        mask, _crop(mask, settings.margin), "automatic", np.rint(255 * chance).astype(np.uint8),
        solid.doubt(mask, chance), *solid.shape(mask),
    )  # fmt: skip


def _picture(radiance: AngleStack, alignment: Alignment, color: ColorCalibration) -> Floats:
    """Mean of the registered shots in linear Rec.709, (H, W, 3)."""
    total = sum(warp(radiance.value[k], alignment.transform[k], order=1) for k in range(len(radiance.angle)))
    return np.asarray(cv2.transform(total, 2 / len(radiance.angle) * color.matrix), np.float32)


def _chart_zone(radiance: AngleStack, color: ColorCalibration, margin: float) -> NDArray[np.uint8]:
    """(H, W) 1 where the chart's patches lie, and up to `margin` patch widths beside them."""
    zone = np.zeros(radiance.value.shape[1:3], np.uint8)
    if color.corners is not None:
        corners = np.asarray(color.corners, np.float64)
        center = corners.mean(0)
        across = np.linalg.norm(corners[1] - corners[0]) / 6  # one patch pitch
        outward = corners - center
        grown = center + outward * (1 + margin * across / np.linalg.norm(outward, axis=1))[:, None]
        cv2.fillConvexPoly(zone, np.round(grown).astype(np.int32), 1)
    return zone


def _crop(mask: NDArray[np.bool_], margin: float) -> tuple[int, int, int, int]:
    """The mask's box with a border, within the picture."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    add = max(4, round(margin * max(np.ptp(rows), np.ptp(columns))))
    height, width = mask.shape
    return (
        max(int(columns[0]) - add, 0), max(int(rows[0]) - add, 0),
        min(int(columns[-1]) + 1 + add, width), min(int(rows[-1]) + 1 + add, height),
    )  # fmt: skip
