"""`polcap.process`: the command `polcap process` from Python."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polcap.config import Config
from polcap.formats.capture import reader as captures
from polcap.images import ChartRequest
from polcap.pipeline import models
from polcap.pipeline import run as pipeline
from polcap.pipeline.cache import Progress, silent
from polcap.pipeline.path import AUTO, UserInput


@dataclass(frozen=True)
class Result:
    """The output of a run."""

    folder: Path  # maps/, asset/, report.html
    report: dict[str, Any]  # report.json's content

    @property
    def verdict(self) -> str:
        """`pass`, `warn` (an assumption to check) or `fail` (a gate failed: do not trust it unseen)."""
        return str(self.report["verdict"])


def process(
    capture: str | Path,
    out: str | Path | None = None,
    *,
    config: Config | None = None,
    angles_deg: tuple[float, ...] | None = None,
    chart: ChartRequest = AUTO,
    mask: NDArray[np.bool_] | None = None,
    estimator: Literal["network", "analytic"] | None = None,
    model: str | Path | None = None,
    progress: Progress = silent,
) -> Result:
    """Turn the photographs of an object into maps and a 3-D asset.

    Parameters
    ----------
    capture
        Folder with the RAW brackets.
    out
        Result folder; by default `CAPTURE/polcap`. Stages that an earlier run has stored there are not computed again.
    config
        Settings; by default those of `docs/reference/settings.md`. `polcap.load_config` reads a file.
    angles_deg
        Polarizer angles of the shots in order, where names do not state them, degrees.
    chart
        How the ColorChecker is found; by default in the reference shot.
    mask
        (H, W), true on the object, on the RAW pixels; by default the object is found.
    estimator
        By default the shipped network, as on the command line; "analytic" inverts the equations.
    model
        Another ONNX file than the shipped one.
    progress
        Called with a stage's name as it begins (None) and ends (its seconds), and whether it was found in the cache.

    Raises
    ------
    PolcapError
        With one line that names the thing, the value, the limit and the remedy.
    """
    folder = Path(capture)
    target = folder / "polcap" if out is None else Path(out)
    network = models.load_network(estimator, None if model is None else Path(model))
    supplied = UserInput(chart=chart, mask=mask, network=network, mask_network=models.load_mask_network())
    found = captures.read(folder, angles_deg)
    about = pipeline.process(found, supplied, config or Config(), target, progress=progress)
    assert about is not None  # only `until` leaves it out
    return Result(target, about)
