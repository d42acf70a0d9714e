"""READ FIRST. In: a capture. Out: every result of its path, one line per stage.

Each line's work is the folder of the same name in `stages/`. Measure, then apply once: white balance,
alignment and self-calibration return small values; `stokes` applies gains and transforms, `cues` the
colour matrix. Images are resampled once.

A line declares its step and computes nothing: the store computes what somebody asks for, or finds it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.config import Config
from polcap.errors import ObjectError
from polcap.formats import shipped_data
from polcap.images import (
    Alignment,
    AngleStack,
    Asset,
    Capture,
    ChartRequest,
    ColorCalibration,
    Cues,
    Gains,
    Mesh,
    Network,
    ObjectMask,
    StokesImage,
    SurfaceMaps,
)
from polcap.pipeline.cache import Archive, StageResult, Store
from polcap.stages import align, asset, cues, hdr, infer, mask, selfcal, stokes, surface, whitebalance

AUTO = ChartRequest("auto")


@dataclass(frozen=True)
class UserInput:
    """What the user gives beside the photographs."""

    chart: ChartRequest = AUTO
    mask: NDArray[np.bool_] | None = None  # on the RAW pixels or on the grid of the merged picture
    network: Network | None = None  # None: the analytic estimator
    mask_network: Network | None = None  # None: the object is what stands out from the backdrop


@dataclass(frozen=True)
class Results:
    """Every result of the path; each is found or computed when its value is asked for."""

    radiance: StageResult[AngleStack]
    color: StageResult[ColorCalibration]
    alignment: StageResult[Alignment]
    object_: StageResult[ObjectMask]
    gains: StageResult[Gains]
    stokes: StageResult[StokesImage]
    cues: StageResult[Cues]
    maps: StageResult[SurfaceMaps]
    mesh: StageResult[Mesh]
    asset: StageResult[Asset]


def path(capture: Capture | None, supplied: UserInput, config: Config, store: Store) -> Results:
    """From RAW brackets to the asset."""
    reference = store.derive(shipped_data.colorchecker, config.whitebalance.chart)
    radiance = store.step(hdr.merge, capture, config=config.hdr)
    color = store.step(whitebalance.measure, radiance, reference, supplied.chart, config=config.whitebalance)
    alignment = store.step(align.register, radiance, color, config=config.align)
    user_mask = store.derive(on_grid, supplied.mask, radiance)
    object_ = store.step(mask.segment, radiance, alignment, color, user_mask, supplied.mask_network, config=config.mask)
    gains = store.step(selfcal.solve, radiance, alignment, object_, color, config=config.selfcal)
    stokes_ = store.step(stokes.solve, radiance, alignment, gains, object_, config=config.stokes)
    cues_ = store.step(cues.compute, stokes_, color)
    maps = store.step(infer.estimate, cues_, supplied.network, config=config.infer)
    distance = store.derive(distance_m, color, radiance)
    mesh = store.step(surface.integrate, maps, distance, config=config.surface)
    asset_ = store.step(asset.build, maps, mesh, config=config.asset)
    return Results(radiance, color, alignment, object_, gains, stokes_, cues_, maps, mesh, asset_)


def on_grid(drawn: NDArray[np.bool_] | None, radiance: AngleStack) -> NDArray[np.bool_] | None:
    """The user's mask (H, W) on the grid of the merged picture.

    It may be drawn there, or on the pixels of the RAW or of the mosaic.

    Raises
    ------
    ObjectError
        It has neither size.
    """
    if drawn is None:
        return None
    height, width = radiance.value.shape[1:3]
    step = 2 if radiance.offset_px is not None else round(radiance.view.scale)
    tall, wide = drawn.shape
    if (tall, wide) == (height, width):
        return drawn
    if abs(tall - step * height) < step and abs(wide - step * width) < step:
        return np.asarray(drawn[::step, ::step][:height, :width])
    sizes = dict.fromkeys(f"{n * width}×{n * height}" for n in (step, 1))
    raise ObjectError(f"--mask is {wide}×{tall} px; draw it on the picture's {' or '.join(sizes)} px")


def distance_m(color: ColorCalibration, radiance: AngleStack) -> float | None:
    """Distance of the chart, and so about that of the object beside it [m]; None where no chart tells."""
    return None if color.metres_per_px is None else color.metres_per_px * radiance.view.focal


STAGES = tuple(step.name for step in vars(path(None, UserInput(), Config(), Archive(Path()))).values())
