"""A reduced capture in, its gates out: the path's own stages on small pictures, each when a gate asks for it."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from polcap.config import Config
from polcap.errors import ChartError, DecodeError, InputError
from polcap.formats import shipped_data
from polcap.images import (
    Alignment,
    AngleStack,
    ChartRequest,
    ColorCalibration,
    Floats,
    Gains,
    Network,
    ObjectMask,
    StokesImage,
    SurfaceMaps,
)
from polcap.parallel import Once
from polcap.pipeline.small_capture import Taken
from polcap.quality import gates
from polcap.quality.gates import Found, Gate
from polcap.stages import align, cues, hdr, infer, mask, selfcal, stokes, whitebalance

_LOOKS = 1  # of the network: what gates read of its maps are medians, which four looks move by 3 % at most


class Reduced:
    """What the stages make of a reduced capture; their own limits are left to the gates."""

    mesh: None = None  # none is made

    def __init__(
        self,
        taken: Taken,
        networks: Callable[[], tuple[Network | None, Network | None]],
        config: Config,
        chart: ChartRequest,
        pool: ThreadPoolExecutor,
    ) -> None:
        self.taken, self.networks, self.config = taken, networks, config
        self.chart = chart
        self.names = [shot.name for shot in taken.capture.shots]
        self.focal_doubt = taken.capture.focal_doubt
        self._object, self._gains = Once(self._segmented), Once(self._solved_gains)
        self._stokes, self._maps = Once(self._solved_stokes), Once(self._estimated)
        self._ahead = Once(lambda: pool.submit(self._maps))
        self.grid_px = taken.step / (taken.binned if config.hdr.demosaic == "superpixel" else 1)

    @cached_property
    def radiance(self) -> AngleStack:
        motion = max(self.config.hdr.max_motion_px / self.taken.step, 1.0)
        merged = hdr.merge(self.taken.capture, msgspec.structs.replace(self.config.hdr, max_motion_px=motion))
        return replace(merged, blur_px=self.taken.blur_px)

    @cached_property
    def _color(self) -> tuple[ColorCalibration, str]:
        """Without a chart the rest can still be judged."""
        reference = shipped_data.colorchecker(self.config.whitebalance.chart)
        step, request = self.taken.step, self.chart
        if request.corners is not None:
            request = replace(request, corners=(request.corners - (step - 1) / 2) / step)
        try:
            return whitebalance.measure(self.radiance, reference, request, self.config.whitebalance), ""
        except ChartError as error:
            if request.mode != "auto":
                raise
            none = whitebalance.measure(self.radiance, reference, ChartRequest("none"), self.config.whitebalance)
            return none, str(error).partition(" (")[2].partition(")")[0] or str(error)

    @property
    def color(self) -> ColorCalibration:
        return self._color[0]

    @property
    def chart_missing(self) -> str:
        return self._color[1]

    @cached_property
    def alignment(self) -> Alignment:
        free = msgspec.structs.replace(self.config.align, max_shift_px=500.0, min_correlation=0.0)
        return align.register(self.radiance, self.color, free)

    @property
    def object_(self) -> ObjectMask:
        found = self._object()
        self._ahead()  # what the last gates ask for is made beside the next ones
        return found

    @property
    def gains(self) -> Gains:
        return self._gains()

    @property
    def stokes(self) -> StokesImage:
        return self._stokes()

    @property
    def maps(self) -> SurfaceMaps:
        return self._maps()

    def _segmented(self) -> ObjectMask:
        return mask.segment(self.radiance, self.alignment, self.color, None, self.networks()[1], self.config.mask)

    def _solved_gains(self) -> Gains:
        unchecked = msgspec.structs.replace(self.config.selfcal, check_order=False)
        return selfcal.solve(self.radiance, self.alignment, self.object_, self.color, unchecked)

    def _solved_stokes(self) -> StokesImage:
        return stokes.solve(self.radiance, self.alignment, self.gains, self.object_, self.config.stokes)

    def _estimated(self) -> SurfaceMaps:
        few = min(self.config.infer.symmetries, _LOOKS)
        settings = msgspec.structs.replace(self.config.infer, symmetries=few, fine=False)
        return infer.estimate(cues.compute(self.stokes, self.color), self.networks()[0], settings)

    def figure(self, name: str, measure: Callable[[Found, Any], Any], setting: Any = None) -> Any:
        """As measured: nothing is remembered."""
        return measure(self, setting)

    @property
    def clipped(self) -> Floats:
        return np.asarray(self.taken.clipped[:, :, self.object_.mask].mean(2).min(1))


def judged(small: Reduced) -> Iterator[Gate]:
    """The gates in the order of the path; where a stage gives up, its error is the last of them."""
    try:
        yield from gates.judge(small, small.config)
    except DecodeError:  # a frame is decoded when the merge asks for it
        raise
    except InputError as error:
        what, _, remedy = str(error).partition("; ")
        yield Gate(type(error).__name__.removesuffix("Error").lower(), "fail", None, None, what, remedy, 45.0)
