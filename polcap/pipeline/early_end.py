"""Explains an error that ends a run of `process` early: the first cause by the gates of `check`, and a picture."""

import msgspec

from polcap.capture_values import Capture
from polcap.config import Config
from polcap.errors import AlignmentError, CaptureError, ChartError, InputError, ObjectError
from polcap.formats import shipped_data
from polcap.formats.maps import png
from polcap.pipeline.cache import StageCache
from polcap.pipeline.path import results_so_far
from polcap.quality import gates
from polcap.quality.advice import advice
from polcap.quality.gate_values import full_size, of_error
from polcap.report import stage_pictures
from polcap.results import ResultsUntilAlign, ResultsUntilHdr, ResultsUntilMask, ResultsUntilWhitebalance
from polcap.stages import align

PICTURE = "stopped.png"  # in work/
_OF_PIXELS = (CaptureError, ChartError, AlignmentError, ObjectError)  # the pictures show more about these


def explain(error: InputError, cache: StageCache, capture: Capture, config: Config) -> InputError | None:
    """The error with the cause that gates find in the stages so far, and a picture of the shots if they show the cause.

    None if the pixels do not explain this error, or no stage has read them.
    """
    reached = results_so_far(cache)
    if not isinstance(error, _OF_PIXELS) or not isinstance(reached, ResultsUntilHdr):
        return None
    found = reached
    if isinstance(error, AlignmentError) and isinstance(reached, ResultsUntilWhitebalance):
        found = _registered(reached, config)
    files = tuple(tuple(capture.file_name(frame) for frame in shot.frames) for shot in capture.shots)
    evidence = full_size(found, capture.focal_doubt, config.align, files)
    first = next(iter(advice(gates.judge(evidence, config.gates, of_error(error)))), of_error(error))
    message = str(error) if first.message == of_error(error).message else f"{first.message}; {first.remedy}"
    if isinstance(reached, ResultsUntilMask):  # the cause is in the polarization, which the shots do not show
        return type(error)(message)
    picture = cache.folder / "work" / PICTURE
    colors = shipped_data.colorchecker(config.whitebalance.chart) if isinstance(error, ChartError) else None
    png.write(picture, stage_pictures.stopped(reached, colors))
    return type(error)(f"{message}; see {picture}")


def _registered(reached: ResultsUntilWhitebalance, config: Config) -> ResultsUntilWhitebalance:
    """The results with the motion of all shots, also of shots that moved too far or show another scene."""
    unlimited = msgspec.structs.replace(config.align, max_shift_px=500.0, min_correlation=0.0)
    try:
        alignment = align.register(reached.radiance, unlimited)
    except AlignmentError:  # there is nothing to register
        return reached
    return ResultsUntilAlign(**vars(reached), alignment=alignment)
