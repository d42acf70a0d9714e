"""Stage 3: find where each polarizer shot sees what the reference shot sees.

Turning the polarizer changes brightness smoothly over the object, a nudge of the camera moves its
texture. So the shots are compared in the logarithm of radiance with everything coarser than a few
pixels taken out: what remains is texture, chart and outline, which polarization hardly touches, and
a robust loss drops the pixels where it does. The transform is refined by Gauss–Newton steps with the
mean of both images' gradients, coarse to fine.
"""

from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import AlignmentError
from polcap.images import Alignment, AngleStack, ColorCalibration, Floats
from polcap.stages import stage
from polcap.stages.align.following import Detail, fine, likeness, refine, to_full_grid

_SURE_LIKENESS = 0.6  # correlation of detail from which no other start is tried; else the likest wins
_MOST_PIXELS = 0.5e6  # a larger image is averaged down first: it has detail to spare


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `align` of a settings file."""

    model: Annotated[
        Literal["none", "translation", "similarity", "homography"],
        Meta(description="how a shot may have moved; none: trust a locked camera"),
    ] = "similarity"
    max_shift_px: Annotated[
        float, Meta(ge=0.5, le=500, description="greatest accepted movement of any shot [grid px]")
    ] = 40.0
    min_correlation: Annotated[
        float, Meta(ge=0, le=1, description="least correlation of detail after registration")
    ] = 0.5
    detail_px: Annotated[
        float,
        Meta(ge=1, le=50, description="structure coarser than this Gaussian sigma is ignored [grid px]"),
    ] = 4.0


@stage(version=7)
def register(radiance: AngleStack, color: ColorCalibration, settings: Settings) -> Alignment:
    """One transform per shot, reference grid px → shot grid px.

    Parameters
    ----------
    radiance
        The shots (K, H, W, 3).
    color
        Tells where the chart lies.
    settings
        How a shot may have moved, and how far.

    Raises
    ------
    AlignmentError
        A shot moved too far, or shows another scene; names it.
    """
    shots = len(radiance.angle)
    if radiance.offset_px is not None:
        return _as_known(radiance.offset_px)
    step = int(np.ceil(np.sqrt(radiance.value[0, ..., 0].size / _MOST_PIXELS)))
    detail_px = settings.detail_px / np.sqrt(step)  # detail lies between the pixels of either grid
    detail = [Detail(fine(radiance.shot(k), detail_px, step)) for k in range(shots)]
    transform = np.tile(np.eye(3), (shots, 1, 1))
    residual = np.zeros(shots)
    correlation = np.ones(shots)
    for k in range(1, shots):
        if settings.model == "none":
            continue
        name = f"shot {np.degrees(radiance.angle[k]):g}°"
        transform[k], residual[k], correlation[k] = _accepted(name, detail[0], detail[k], step, settings)
    crossed: Floats | None = None
    if radiance.crossed is not None and settings.model == "none":
        crossed = np.eye(3)
    elif radiance.crossed is not None:
        last = Detail(fine(radiance.crossed.picture, detail_px, step))
        crossed, _, _ = _accepted("the cross-polarised shot", detail[0], last, step, settings)
    return Alignment(transform=transform, residual_px=residual, correlation=correlation, crossed=crossed)


def _accepted(name: str, reference: Detail, shot: Detail, step: int, settings: Settings) -> tuple[Floats, float, float]:
    """Transform (3, 3) of a shot on the full grid, its 1σ in px of that, and the likeness; refuses what cannot be."""
    if not (reference[1].tells and shot[1].tells):
        raise AlignmentError(
            f"{name} has no unclipped detail in common with the first shot: over-exposed, black, or even all over; "
            "shoot a darker frame, or with a locked camera --set align.model=none"
        )
    small, residual, correlation = _find(reference, shot, settings.model)
    transform = to_full_grid(small, step)
    height, width = (step * side for side in reference[1].value.shape)
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], float).T
    moved = transform @ corners
    shift = np.abs(moved[:2] / moved[2] - corners[:2]).max()
    if not np.isfinite(shift) or correlation < settings.min_correlation:
        raise AlignmentError(
            f"{name} shows another scene than the first shot: correlation {correlation:.2f}, "
            f"less than align.min_correlation = {settings.min_correlation:g}; "
            "check its files, or reshoot with the camera and the object held still"
        )
    if shift > settings.max_shift_px:
        raise AlignmentError(
            f"{name} moved by {shift:.1f} px, more than align.max_shift_px = {settings.max_shift_px:g}; "
            "reshoot, or raise it"
        )
    return transform, residual * step, correlation


def _as_known(offset_px: Floats) -> Alignment:
    """Shots cut from one mosaic stand where its pixels stand."""
    transform = np.tile(np.eye(3), (len(offset_px), 1, 1))
    transform[:, :2, 2] = -offset_px
    return Alignment(transform, np.zeros(len(offset_px)), np.ones(len(offset_px)))


def _find(reference: Detail, shot: Detail, model: str) -> tuple[Floats, float, float]:
    """Transform of a shot, its 1σ in px, and the likeness of the two shots under it.

    Polarization may change which side of an edge is bright: where the detail is little alike, the edges are compared
    in its place, and from where a camera stands that was not touched.
    """
    found = _follow(reference, shot, _coarse_shift(reference, shot), model)
    if found[2] > _SURE_LIKENESS:
        return found
    edges, still = (reference.edges(), shot.edges()), np.zeros(2)
    others = [
        _follow(reference, shot, still, model),
        _follow(*edges, _coarse_shift(*edges), model),
        _follow(*edges, still, model),
    ]
    return max(found, *others, key=lambda one: one[2])


def _follow(reference: Detail, shot: Detail, shift: Floats, model: str) -> tuple[Floats, float, float]:
    """The same from a first shift (2,) px."""
    start = np.eye(3)
    start[:2, 2] = shift
    transform, residual = refine(reference, shot, start, model)
    return transform, residual, likeness(reference, shot, transform)


def _coarse_shift(reference: Detail, shot: Detail) -> Floats:
    """Whole-image translation by phase correlation at half size, (2,) px."""
    a, b = reference[2], shot[2]
    window = cv2.createHanningWindow(a.value.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(a.value * np.sqrt(a.weight), b.value * np.sqrt(b.weight), window)
    return 2 * np.array(shift)
