"""Stage 3: register every polarizer shot with the reference shot.

A turn of the polarizer changes brightness smoothly over the object. A move of the camera shifts its texture. So the
shots are compared in the fine structure of the logarithm of radiance (`detail`): texture, chart and outline, which
polarization hardly changes. Tiles in which it does change them are outliers of the fit (`optics.registration`).
"""

from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import AlignmentError
from polcap.image_values import Floats, MaskedImage, Quality
from polcap.optics import registration
from polcap.optics.projection import picture_corners, transform_points
from polcap.optics.registration import Pyramid
from polcap.optics.resize import block_step
from polcap.stage_values import Alignment, AngleStack
from polcap.stages import stage
from polcap.stages.align.detail import detail, edge_strength, shows_detail

_GOOD_CORRELATION = 0.6  # of detail; above it edges need not be compared
_MOST_PIXELS = 0.5e6  # a larger picture is averaged down first: it has detail to spare
_OVEREXPOSED, _TOO_DARK = 0.2, 3.0  # clipped share of a picture; signal over noise of its median pixel
_FLOOR_PX = 0.02  # error by aliasing, with any noise; the shots of tests/capture have .026 and .025 (decision 19)


class AlignSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `align`, the section `align` of a settings file."""

    model: Annotated[
        Literal["none", "translation", "similarity", "homography"],
        Meta(description="motion model between shots; none: the camera was locked"),
    ] = "similarity"
    max_shift_px: Annotated[
        float, Meta(ge=0.5, le=500, description="greatest accepted movement of any shot [merged px]")
    ] = 40.0
    min_correlation: Annotated[
        float, Meta(ge=0, le=1, description="least correlation of detail after registration")
    ] = 0.5
    detail_px: Annotated[
        float, Meta(ge=1, le=50, description="structure coarser than this Gaussian sigma is ignored [merged px]")
    ] = 4.0


@stage(version=10)
def register(radiance: AngleStack, settings: AlignSettings) -> Alignment:
    """Register every shot with the reference shot: transforms (K, 3, 3) from its merged px to those of each shot.

    Raises AlignmentError, which names the shot: it moved too far, or shows another scene.
    """
    shots = len(radiance.angle)
    transform, residual, correlation = np.tile(np.eye(3), (shots, 1, 1)), np.zeros(shots), np.ones(shots)
    if radiance.offset_px is not None:  # all shots are cut from one frame of a polarization sensor
        transform[:, :2, 2] = -radiance.offset_px
        return Alignment(transform, residual, correlation)
    crossed: Floats | None = None if radiance.crossed is None else np.eye(3)
    if settings.model == "none":
        return Alignment(transform, residual, correlation, crossed)
    step = block_step(radiance.quality[0].size, _MOST_PIXELS)
    reference = _detail(radiance.shot(0), step, settings)
    for k in range(1, shots):
        name = f"shot {np.degrees(radiance.angle[k]):g}°"
        transform[k], residual[k], correlation[k] = _register_shot(name, radiance.shot(k), reference, step, settings)
    if radiance.crossed is not None:
        name = "the cross-polarized shot"
        crossed, _, _ = _register_shot(name, radiance.crossed.picture, reference, step, settings)
    return Alignment(transform, residual, correlation, crossed)


def _detail(shot: MaskedImage, step: int, settings: AlignSettings) -> Pyramid:
    """Fine detail of a shot, averaged over `step` × `step` px."""
    return detail(shot, settings.detail_px / np.sqrt(step), step)  # between this width in px and in averaged px


def _no_detail(name: str, picture: MaskedImage) -> AlignmentError:
    """Error of a shot that shares no detail with the first one, with the likely cause."""
    clipped_share = float(((picture.quality & int(Quality.CLIPPED)) > 0).mean())
    signal = float(np.median(picture.value / np.sqrt(np.maximum(picture.variance, 1e-12))))
    cause, remedy = "even all over", "put something with texture next to the object"
    if clipped_share > _OVEREXPOSED:
        cause, remedy = f"{clipped_share:.0%} of it is over-exposed", "shoot with less light, or add a darker exposure"
    elif signal < _TOO_DARK:
        cause, remedy = "it is too dark", "use more light or a longer exposure"
    return AlignmentError(
        f"{name} has no unclipped detail in common with the first shot: {cause}; "
        f"{remedy}; with a locked camera, --set align.model=none"
    )


def _register_shot(
    name: str, picture: MaskedImage, reference: Pyramid, step: int, settings: AlignSettings
) -> tuple[Floats, float, float]:
    """Register one shot: transform (3, 3) and its 1σ in merged px, and the correlation of detail.

    `reference` is the detail of the reference shot, averaged over `step` × `step` px. Raises AlignmentError.
    """
    shot = _detail(picture, step, settings)
    if not (shows_detail(reference) and shows_detail(shot)):
        raise _no_detail(name, picture)
    motion, correlation = _best_match(reference, shot, settings)
    transform = registration.scaled(motion.matrix, step)
    corners = picture_corners(step * reference.shape[1], step * reference.shape[0])
    shift = np.abs(transform_points(transform, corners) - corners).max()
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
    return transform, step * float(np.hypot(motion.sigma_px, _FLOOR_PX)), correlation


def _best_match(reference: Pyramid, shot: Pyramid, settings: AlignSettings) -> tuple[registration.Registration, float]:
    """Find the motion under which two shots correlate best, in their detail or in the strength of their edges.

    Strong polarization may change which side of an edge is brighter, but not where the edge is. Returns the motion and
    the correlation.
    """
    assert settings.model != "none"
    found = registration.register(reference, shot, settings.model)
    correlation = registration.correlation(reference, shot, found.matrix)
    if correlation > _GOOD_CORRELATION:
        return found, correlation
    edges = edge_strength(reference), edge_strength(shot)
    by_edges = registration.register(*edges, settings.model)
    edge_correlation = registration.correlation(*edges, by_edges.matrix)
    return (by_edges, edge_correlation) if edge_correlation > correlation else (found, correlation)
