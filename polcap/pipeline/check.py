"""In: a capture, seconds after its last frame. Out: keep or reshoot, and why.

The path's own stages judge, on pictures averaged down to at most 0.6 MP; what that would hide is taken from
the full pictures as they are read. Nothing is written.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter

import msgspec

from polcap.config import Config
from polcap.images import Capture, ChartRequest, Network
from polcap.pipeline import small_capture as reduced
from polcap.pipeline import small_capture_run as judge
from polcap.pipeline.path import AUTO
from polcap.quality.gates import Gate
from polcap.stages.infer import body_law

Networks = tuple[Network | None, Network | None]  # the estimator's, the mask's


class Verdict(msgspec.Struct, frozen=True):
    """What to do with the capture."""

    keep: bool
    shots: tuple[str, ...]  # to be taken again, as far as single ones are to blame
    lines: tuple[Gate, ...]
    capture: str
    seconds: float
    needs: str = ""  # the option without which `polcap process` ends with an error


def inspect(
    capture: Capture,
    networks: Callable[[], Networks],
    config: Config,
    chart: ChartRequest = AUTO,
) -> Verdict:
    """Judge a capture.

    Parameters
    ----------
    capture
        Its frames are decoded, averaged down and forgotten.
    networks
        Loads the estimator's and the mask's, while frames are decoded. Without the first the errors of the analytic
        estimator are expected; without the second the object is what stands out from the backdrop.
    config
        Settings of the stages, and the gates' limits.
    chart
        As given to `process`.

    Raises
    ------
    InputError
        A frame cannot be decoded.
    """
    start = perf_counter()
    with ThreadPoolExecutor(2) as pool, ThreadPoolExecutor(1) as beside:
        loaded = beside.submit(_warm, networks, config.infer.ior)
        try:
            taken = reduced.take(capture, config.hdr.clip, pool)
            lines = tuple(judge.judged(judge.Reduced(taken, loaded.result, config, chart, pool)))
        finally:
            pool.shutdown(cancel_futures=True)
    bad = [line for line in lines if line.state == "fail"]
    named = {name for line in bad for name in line.shots}
    shots = tuple(shot.name for shot in capture.shots if shot.name in named)
    missing = any(line.name == "chart" and line.state == "warn" for line in lines)
    seconds = round(perf_counter() - start, 2)
    return Verdict(not bad, shots, lines, capture.name, seconds, "--no-chart" if missing else "")


def _warm(networks: Callable[[], Networks], ior: float) -> Networks:
    """Load what the stages need besides, while the reference frame is decoded and the second core waits."""
    import scipy.spatial.transform
    import scipy.special  # noqa: F401

    import polcap.optics.colour_science  # noqa: F401

    found = networks()
    for network in found:
        if network is not None:
            network.warm()
    body_law.laws(ior)
    return found


def table(verdict: Verdict) -> str:
    """The verdict for a person, in one screen."""
    head = "keep" if verdict.keep else f"reshoot {', '.join(verdict.shots)}".rstrip()
    if verdict.keep and verdict.needs:
        head += f", and process it with {verdict.needs}"
    rows = [f"{head}   ({verdict.capture}, {verdict.seconds:.1f} s)"]
    for line in verdict.lines:
        cost = f"; costs about {line.cost_deg:.0f}°" if line.cost_deg >= 1 and line.state in ("warn", "fail") else ""
        rows.append(f"{line.state:13}{line.name:14}{line.says}{_limit(line)}{cost}")
        if line.remedy:
            rows.append(f"{'':27}→ {line.remedy}")
    return "\n".join(rows)


def _limit(line: Gate) -> str:
    if not isinstance(line.limit, float | int):
        return ""
    return (
        f" (limit {100 * line.limit:g} %)"
        if line.unit == "%"
        else f" (limit {line.limit:g} {line.unit})".replace(" )", ")")
    )


def shown(verdict: Verdict) -> dict[str, object]:
    """The verdict for a program."""
    return {"verdict": "keep" if verdict.keep else "reshoot", **msgspec.to_builtins(verdict)}
