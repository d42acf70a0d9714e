"""`polcap check`: decides seconds after the last frame whether to keep a capture or reshoot, and why.

The path runs on pictures averaged down to at most 0.6 MP, with a cache in memory: nothing is written. Facts that
averaging hides (clipping, sharpness) are measured at full size while frames are decoded.
"""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import msgspec

from polcap.capture_values import Capture
from polcap.chart_values import ChartRequest, ColorCalibration
from polcap.config import Config
from polcap.errors import ChartError, DecodeError, InputError
from polcap.formats.capture import folder_names
from polcap.optics.projection import to_grid
from polcap.pipeline import models, small_capture
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import AUTO, UserInput, path, results_so_far
from polcap.pipeline.small_capture import SmallCapture
from polcap.quality import gates
from polcap.quality.advice import advise
from polcap.quality.gate_values import Evidence, Gate, of_error
from polcap.results import ResultsUntilInfer, ResultsUntilWhitebalance
from polcap.stage_values import Network

_THREADS = 2  # frames that are decoded at a time
_SYMMETRIES = 2  # positions of the picture that the network sees, instead of 4: gates read medians of its maps only


class Verdict(msgspec.Struct, frozen=True):
    """Result of `polcap check`: whether to keep the capture, the judged gates, and shots to repeat."""

    keep: bool
    shots: tuple[str, ...]  # names of the shots to take again; empty: no single shot is the cause
    lines: tuple[Gate, ...]
    capture: str
    seconds: float
    needs: str = ""  # the option without which `polcap process` ends with an error


def inspect(
    capture: Capture,
    config: Config,
    chart: ChartRequest = AUTO,
    networks: Callable[[], tuple[Network | None, Network | None]] = models.load_networks,
) -> Verdict:
    """Judge a capture for `polcap check`, by the same gates as `process`.

    `networks` opens the networks of estimator and mask while frames are decoded. Without the first, the errors of the
    analytic estimator are expected; without the second, the object is found by its contrast to the backdrop.

    Raises InputError: a frame cannot be decoded, or a chart was named and cannot be read.
    """
    start = perf_counter()
    with ThreadPoolExecutor(_THREADS) as pool:
        try:
            small = small_capture.reduce(capture, config.hdr.clip, pool)
            supplied = UserInput(_scale_chart(chart, small.step), None, *networks(), small.decode)
            lines = tuple(_judge(capture, small, supplied, config))
        finally:
            pool.shutdown(cancel_futures=True)
    fails = [line for line in lines if line.state == "fail"]
    blamed = {name for line in fails for name in line.shots if capture.layout != "sensor"}  # its frame holds all angles
    shots = tuple(shot.name for shot in capture.shots if shot.name in blamed)
    missing = any(line.name == "chart" and line.state == "warn" for line in lines)
    seconds = round(perf_counter() - start, 2)
    return Verdict(not fails, shots, lines, capture.name, seconds, "--no-chart" if missing else "")


def _judge(capture: Capture, small: SmallCapture, supplied: UserInput, config: Config) -> list[Gate]:
    """Judge the reduced capture by the gates, in the order of the path; an error of a stage is the last gate."""
    cache, chart_missing = MemoryCache(), ""
    failure: InputError | None = None
    try:
        chart_missing = _run_path(capture, small, supplied, config, cache)
    except DecodeError:
        raise
    except InputError as error:
        failure = error
    evidence = Evidence(
        results_so_far(cache),
        names=[shot.name for shot in small.capture.shots],
        focal_doubt=small.capture.focal_doubt,
        clipped=small.clipped,
        blur_px=small.blur_px,
        align=config.align,
        files=tuple(tuple(capture.file_name(frame) for frame in shot.frames) for shot in capture.shots),
        grid_px=small.step / (small.merged_px if config.hdr.demosaic == "superpixel" else 1),
        chart_missing=chart_missing,
        later_view=folder_names.is_later_view(Path(capture.folder)),
    )
    return advise(gates.judge(evidence, config.gates, None if failure is None else of_error(failure)))


def _run_path(capture: Capture, small: SmallCapture, supplied: UserInput, config: Config, cache: MemoryCache) -> str:
    """Run the path on the reduced capture; the results are in `cache`.

    If the small pictures show no chart, it is searched at full size, as `process` does. If there is none, the path runs
    without a chart, and the reason is returned; otherwise "".
    """
    missing, settings = "", _settings(config, small.step)
    try:
        path(small.capture, supplied, settings, cache, ResultsUntilInfer)
    except ChartError:
        if supplied.chart.mode != "auto":
            raise
        request = ChartRequest("none")
        try:
            request = ChartRequest("profile", profile=_colors_at_full_size(capture, config))
        except ChartError as error:
            missing = error.reason
        path(small.capture, replace(supplied, chart=request), settings, cache, ResultsUntilInfer)
    return missing


def _colors_at_full_size(capture: Capture, config: Config) -> ColorCalibration:
    """The color calibration of the reference shot at full size, as `process` makes it. Raises ChartError."""
    first = replace(capture, shots=capture.shots[:1], crossed=None)
    return path(first, UserInput(), config, MemoryCache(), ResultsUntilWhitebalance).color


def _settings(config: Config, step: int) -> Config:
    """Settings of the path for the reduced pictures, without the stages' own limits: the gates judge instead."""
    with_values = msgspec.structs.replace
    return with_values(
        config,
        hdr=with_values(config.hdr, max_motion_px=max(config.hdr.max_motion_px / step, 1.0)),
        align=with_values(config.align, max_shift_px=500.0, min_correlation=0.0),
        selfcal=with_values(config.selfcal, check_order=False),
        infer=with_values(config.infer, symmetries=min(config.infer.symmetries, _SYMMETRIES), fine=False),
    )


def _scale_chart(chart: ChartRequest, step: int) -> ChartRequest:
    """Convert the chart's corners from the user to the reduced pictures, with pixels of `step` × `step` RAW pixels."""
    return chart if chart.corners is None else replace(chart, corners=to_grid(chart.corners, step))


def table(verdict: Verdict, everything: bool = False) -> str:
    """The verdict as text for the terminal: the gates that did not pass, or all gates."""
    head = "keep" if verdict.keep else f"reshoot {', '.join(verdict.shots)}".rstrip()
    if not verdict.keep and not verdict.shots:  # the fault is of the whole capture
        head += f": {', '.join(line.name for line in verdict.lines if line.state == 'fail')}"
    if verdict.keep and verdict.needs:
        head += f", and process it with {verdict.needs}"
    rows = [f"{head}   ({verdict.capture}, {verdict.seconds:.1f} s)"]
    shown = [line for line in verdict.lines if everything or line.state in ("fail", "warn")]
    if not everything:
        shown = sorted(shown, key=lambda line: (line.state != "fail", not line.remedy))
    width = max((len(line.name) for line in shown), default=0) + 2
    for line in shown:
        limit = ""
        if isinstance(line.limit, float | int):
            number, unit = (100 * line.limit, "%") if line.unit == "1" else (line.limit, line.unit)
            limit = f" (limit {number:g} {unit})".replace(" )", ")")
        cost = f", costs about {line.cost_deg:.0f}°" if line.cost_deg >= 1 and line.state in ("warn", "fail") else ""
        rows.append(f"{line.state:13}{line.name:{width}}{line.message}{limit}{cost}")
        if line.remedy:
            rows.append(f"{'':{13 + width}}→ {line.remedy}")
    if not everything:
        count = Counter(line.state for line in verdict.lines)
        after = [f", {count[state]} {state}" for state in ("not measured", "not judged") if count[state]]
        rows.append(f"{count['pass']} of {len(verdict.lines)} gates passed{''.join(after)}; -v prints all")
    return "\n".join(rows)


def to_json(verdict: Verdict) -> dict[str, object]:
    """The verdict as data for JSON."""
    return {"verdict": "keep" if verdict.keep else "reshoot", **msgspec.to_builtins(verdict)}
