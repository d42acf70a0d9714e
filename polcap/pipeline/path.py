"""READ FIRST. The path of a capture, one line per stage: from RAW brackets to depth and mesh.

The code of a stage is in the folder of the same name in `stages/`. White balance, alignment and self-calibration only
measure: they return small values. `stokes` applies gains and transforms, `cues` the color matrix, so images are
resampled once. `cache.run` reads a stored result, or computes it. `process`, `check`, `show` and a dry run all follow
this path, with different caches. `run.py` then writes maps/, and `asset_export.py` builds the asset from these files.
"""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from polcap.capture_values import Capture, Decode
from polcap.chart_values import ChartRequest, ColorCalibration
from polcap.config import Config
from polcap.errors import ObjectError
from polcap.formats import onnx, shipped_data
from polcap.formats.raw import frame_decoder
from polcap.image_values import Bools
from polcap.pipeline.cache import MemoryCache, StageReached
from polcap.results import FirstResults, R, collect, last_stage
from polcap.stage_values import AngleStack, Network, OtherOrder, SelfCalibration
from polcap.stages import align, cues, hdr, infer, mask, selfcal, stokes, surface, whitebalance

AUTO = ChartRequest("auto")


@dataclass(frozen=True)
class UserInput:
    """Inputs of the path besides the photographs: chart, mask, networks, decoder."""

    chart: ChartRequest = AUTO
    mask: Bools | None = None  # on the RAW pixels or on the merged picture
    network: Network | None = None  # None: the analytic estimator
    mask_network: Network | None = None  # None: the object is found by its contrast to the backdrop
    decode: Decode = frame_decoder.decode  # the pixels of a photograph


def path(capture: Capture | None, supplied: UserInput, config: Config, cache: MemoryCache, wanted: type[R]) -> R:
    """Run the stages in order, up to the last one of the `wanted` results."""
    cache.until = last_stage(wanted)
    with suppress(StageReached):
        run_stages(capture, supplied, config, cache)
    results = results_so_far(cache)
    assert isinstance(results, wanted)
    return results


def run_stages(capture: Capture | None, supplied: UserInput, config: Config, cache: MemoryCache) -> None:
    """Run the stages in order; their results are in `cache`.

    Raises StageReached: this was the last stage that the path needs.
    """
    with ThreadPoolExecutor(1) as background:
        colors = background.submit(shipped_data.colorchecker, config.whitebalance.chart)  # imports a large library
        radiance = cache.run(hdr.merge, capture, supplied.decode, config=config.hdr)
        color = cache.run(whitebalance.measure, radiance, colors.result(), supplied.chart, config=config.whitebalance)
        alignment = cache.run(align.register, radiance, config=config.align)
        drawn = cache.derive(on_grid, supplied.mask, radiance)
        mask_network = supplied.mask_network
        object_ = cache.run(mask.segment, radiance, alignment, color, drawn, mask_network, onnx.run, config=config.mask)
        calibration = cache.run(selfcal.solve, radiance, alignment, object_, color, config=config.selfcal)
        stokes_ = cache.run(stokes.solve, radiance, alignment, calibration, object_, config=config.stokes)
        cues_ = cache.run(cues.compute, stokes_, color, cache.derive(other_orders, calibration))
        maps = cache.run(infer.estimate, cues_, supplied.network, onnx.run, config=config.infer)
        distance = cache.derive(distance_m, color, radiance)
        cache.run(surface.integrate, maps, distance, config=config.surface)


def results_so_far(cache: MemoryCache) -> FirstResults:
    """The results of the stages that have run; after an error, those of the stages before it."""
    keys = {stage: result.key for stage, result in cache.results.items()}
    return collect({stage: result.value for stage, result in cache.results.items()}, keys)


def on_grid(drawn: Bools | None, radiance: AngleStack) -> Bools | None:
    """Convert the user's mask to the size of the merged picture (H, W).

    The user may draw it in that size, or on the pixels of the RAW or of the mosaic.

    Raises ObjectError: the mask has none of these sizes.
    """
    if drawn is None:
        return None
    height, width = radiance.value.shape[1:3]
    # pixels of the file per pixel of the merged picture: a polarization sensor's cells are 2×2
    step = 2 if radiance.offset_px is not None else round(radiance.view.scale)
    tall, wide = drawn.shape
    if (tall, wide) == (height, width):
        return drawn
    if abs(tall - step * height) < step and abs(wide - step * width) < step:  # rows for a part of a pixel are cut off
        return np.asarray(drawn[::step, ::step][:height, :width])
    sizes = dict.fromkeys(f"{n * width}×{n * height}" for n in (step, 1))
    raise ObjectError(f"--mask is {wide}×{tall} px; draw it on the picture's {' or '.join(sizes)} px")


def other_orders(calibration: SelfCalibration) -> tuple[OtherOrder, ...]:
    """Orders of the shots that the outline does not exclude; the estimators test them."""
    return calibration.other_orders


def distance_m(color: ColorCalibration, radiance: AngleStack) -> float | None:
    """Distance of the object [m], assumed equal to the chart's; None without a chart of known size."""
    return None if color.metres_per_px is None else color.metres_per_px * radiance.view.focal
