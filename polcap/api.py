"""Python interface: `polcap.process` does the same as the command `polcap process`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from polcap import resource_limits
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import SettingError
from polcap.formats import own_folders
from polcap.images import Bools, Device
from polcap.pipeline import models
from polcap.pipeline import run as pipeline
from polcap.pipeline.cache import Progress, silent
from polcap.pipeline.path import AUTO
from polcap.pipeline.request import Request


@dataclass(frozen=True)
class Result:
    """Result of `polcap.process`: the result folder, and the content of its report.json."""

    folder: Path  # maps/, asset/, report.html
    report: dict[str, Any]  # report.json's content

    def __repr__(self) -> str:
        return f"Result({str(self.folder)!r}, verdict {self.verdict})"

    @property
    def verdict(self) -> str:
        """`pass`, `warn` (check an assumption) or `fail` (a gate failed: check the result before use)."""
        return str(self.report["verdict"])

    @property
    def expected_error_deg(self) -> float | None:
        """Median expected error of the normals with the costs of all checks, degrees; None: it was not measured."""
        return None if self.report["expected_error_deg"] is None else float(self.report["expected_error_deg"])

    @property
    def asset(self) -> Path:
        """The GLB file."""
        return self.folder / "asset" / f"{self.report['capture']['name']}.glb"


def process(
    capture: str | Path,
    out: str | Path | None = None,
    *,
    config: Config | None = None,
    angles_deg: tuple[float, ...] | None = None,
    clockwise: bool = False,
    chart: ChartRequest = AUTO,
    mask: Bools | None = None,
    estimator: models.Estimator | None = None,
    model: str | Path | None = None,
    device: Device = "cpu",
    threads: int = 0,
    memory: float = 0.0,
    progress: Progress = silent,
) -> Result:
    """Turn the photographs of an object into maps and a 3-D asset. One argument per option of the command.

    Parameters
    ----------
    capture
        Folder with the photographs.
    out
        Result folder; by default `CAPTURE/polcap`. Stages stored there by an earlier run are not computed again.
    config
        Settings; by default those of `docs/reference/settings.md`. `polcap.load_config` reads a file.
    angles_deg
        Polarizer angles of the shots in order, degrees; by default from the names of folders or files.
    clockwise
        Whether the polarizer was turned clockwise as seen in the picture.
    chart
        Source of the color calibration; by default a ColorChecker in the reference shot. `ChartRequest("none")` uses
        the camera's own colors.
    mask
        (H, W), true on the object, in RAW pixels; by default the object is detected.
    estimator
        "network" or "analytic", which inverts the equations; by default the shipped network.
    model
        ONNX file to use instead of the shipped one.
    device
        Where the network runs: "cpu", "cuda" or "auto".
    threads
        Threads to use; 0 is all. It applies to this Python process and stays set.
    memory
        Most memory to take, GB; 0 is no limit. It applies to this Python process and stays set.
    progress
        Called at the start and the end of each stage, with its name, seconds (None at the start) and whether it was
        cached.

    Raises
    ------
    PolcapError
        Its message is one line: the thing, its value, the limit and the remedy.
    """
    _check_types(config, chart, mask)
    folder = Path(capture)
    target = folder / own_folders.OUTPUT if out is None else Path(out)
    resource_limits.set_limits(threads, memory)
    request = Request(
        config=config or Config(), chart=chart, mask=mask, estimator=estimator,
        model=None if model is None else Path(model), device=device, angles_deg=angles_deg, clockwise=clockwise,
        threads=threads,
    )  # fmt: skip
    found, supplied = request.open(folder)
    about = pipeline.process(found, supplied, request.config, target, progress=progress)
    assert about is not None  # only `until` leaves it out
    return Result(target, about)


def _check_types(config: object, chart: object, mask: object) -> None:
    """Refuse values of other types before anything is written.

    Raises SettingError: a value has another type.
    """
    for name, value, usable, remedy in (
        ("config", config, config is None or isinstance(config, Config), "give that of polcap.load_config(…)"),
        ("chart", chart, isinstance(chart, ChartRequest), 'give polcap.ChartRequest("none") or another one'),
        ("mask", mask, mask is None or np.ndim(np.asarray(mask)) == 2, "give an array (H, W), true on the object"),
    ):
        if not usable:
            raise SettingError(f"{name} = {value!r:.60}: cannot be used; {remedy}")
