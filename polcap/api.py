"""Python interface: `process`, `check`, `export` and `fuse` do the same as the commands of these names."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

import numpy as np

from polcap import resource_limits
from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import PolcapError, SettingError
from polcap.formats import own_folders
from polcap.formats.export.encoders import Kind
from polcap.formats.export.glb_geometry import Geometry
from polcap.formats.export.presets import Format
from polcap.formats.export.texture_set import Extra
from polcap.image_values import Bools, Device
from polcap.pipeline import asset_export, export_request, models
from polcap.pipeline import check as checks
from polcap.pipeline import run as pipeline
from polcap.pipeline.cache import Progress, silent
from polcap.pipeline.export_request import ExportRequest
from polcap.pipeline.path import AUTO
from polcap.pipeline.request import Request

if TYPE_CHECKING:
    from polcap.fusion.fusion_path import SessionConfig

_FLAG = re.compile(r"--([a-z]+(?:-[a-z]+)*)")
# argument by option of the command line, where the names differ
_ARGUMENT_OF = {"angles": "angles_deg", "set": "config", "about": "catalog", "extra": "extras", "no-chart": "chart"}
_Arguments = ParamSpec("_Arguments")
_Returned = TypeVar("_Returned")
_Name = TypeVar("_Name", bound=str)


def _in_python(function: Callable[_Arguments, _Returned]) -> Callable[_Arguments, _Returned]:
    """A function whose errors name its arguments, not the flags of the command line."""
    names = inspect.signature(function).parameters

    def argument(flag: re.Match[str]) -> str:
        name = _ARGUMENT_OF.get(flag[1], flag[1].replace("-", "_"))
        return name if name in names else flag[0]

    @wraps(function)
    def called(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Returned:
        try:
            return function(*arguments, **options)
        except PolcapError as error:
            error.args = tuple(_FLAG.sub(argument, part) if isinstance(part, str) else part for part in error.args)
            raise

    return called


@dataclass(frozen=True)
class Result:
    """Result of `polcap.process` or `polcap.fuse`: the result folder, and the content of its report.json."""

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
        """Median expected error of the normals with the costs of all gates, degrees; None: it was not measured."""
        error = self.report.get("expected_error_deg")
        return None if error is None else float(error)

    @property
    def asset(self) -> Path:
        """The GLB file."""
        return self.folder / "asset" / f"{self.report['capture']['name']}.glb"


@_in_python
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


@_in_python
def check(
    capture: str | Path,
    *,
    config: Config | None = None,
    angles_deg: tuple[float, ...] | None = None,
    clockwise: bool = False,
    chart: ChartRequest = AUTO,
) -> checks.Verdict:
    """Judge a capture in seconds: keep or reshoot, and why. Arguments as for `process`; writes nothing.

    `Verdict.keep` tells whether to keep it, `lines` has the gates, `shots` the shots to repeat.

    Raises
    ------
    PolcapError
        Its message is one line: the thing, its value, the limit and the remedy.
    """
    from polcap.formats.capture import reader

    _check_types(config, chart, None)
    return checks.inspect(reader.read(Path(capture), angles_deg, clockwise), config or Config(), chart)


@_in_python
def export(
    result: str | Path | Result,
    preset: str | None = None,
    *,
    out: str | Path | None = None,
    formats: Format | Sequence[Format] = (),
    images: Kind | None = None,
    geometry: Geometry | None = None,
    triangles: int | None = None,
    color: str = "lin_rec709",
    bits: Literal[8, 16] | None = None,
    extras: Extra | Sequence[Extra] = (),
    texture_size: int | None = None,
    page: str | Path | None = None,
    iiif: str | None = None,
    catalog: Mapping[str, str] | None = None,
    lod: int = 0,
) -> list[Path]:
    """Write the asset of a result again, in other formats or for one program; returns the files.

    Parameters
    ----------
    result
        Result folder of `process` or `fuse`, its `Result`, or the folder of the capture or the views.
    preset
        Target program, such as "unreal", with its formats; `docs/how-to/export.md` lists all.
    out
        New result folder for the files and a copy of the maps. An archive needs one, because it stays as it is.
    formats
        Without a preset: of gltf, obj, ply, stl, usd, usdz, materialx, exr, iiif, sfp; by default gltf and obj.
    images, geometry
        Inside the GLB: "png", "jpeg", "webp" or "ktx2"; "float", "quantized" or "draco".
    triangles, texture_size
        Largest number of triangles, by default the preset's or that of the full mesh; longer side of the textures, px.
    color
        Color space or OCIO role of the colors in the layered EXR.
    bits
        Bits per channel of PNG textures.
    extras
        Further textures: "displacement", "occlusion", "object-normal", …
    page
        File model-viewer.min.js, for a web page that shows the GLB.
    iiif
        Address where the relightable layer will be served.
    catalog
        Facts such as title and rights, in place of those of the capture.
    lod
        Number of further levels of detail.

    Raises
    ------
    PolcapError
        Its message is one line: the thing, its value, the limit and the remedy.
    """
    folder = result.folder if isinstance(result, Result) else own_folders.find_result(Path(result))
    request = ExportRequest(
        formats=_names(formats), preset=preset, images=images, geometry=geometry, triangles=triangles, color=color,
        bits=bits, extras=_names(extras), texture_size=texture_size, page=None if page is None else Path(page),
        iiif=iiif, catalog=catalog or {}, lod=lod,
    )  # fmt: skip
    return write_exports(folder, request, out=None if out is None else Path(out))


def write_exports(folder: Path, *requests: ExportRequest, out: Path | None = None) -> list[Path]:
    """Write the asset of a result for each request: of one view, of a fused object or of a material; returns the files.

    They go into the result's folder, or into the new folder `out`, with a copy of the maps.

    Raises SettingError: a preset or color space does not exist, a package or encoder is missing, or `out` is in use.
    """
    from polcap.fusion import fuse_run, fused_maps
    from polcap.material import material_maps, material_run

    if out is not None:
        for one in requests:
            export_request.check(one)
        asset_export.copy(folder, out)
        folder = out
    if fused_maps.is_fused(folder):
        return fuse_run.export(folder, *requests)
    if material_maps.is_material(folder):
        return material_run.export(folder, *requests)
    return pipeline.export(folder, *requests)


@_in_python
def fuse(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    config: "SessionConfig | None" = None,
    angles_deg: tuple[float, ...] | None = None,
    clockwise: bool = False,
    chart: ChartRequest = AUTO,
    estimator: models.Estimator | None = None,
    model: str | Path | None = None,
    device: Device = "cpu",
    workers: int = 1,
    threads: int = 0,
    memory: float = 0.0,
    notify: Callable[[str], None] = lambda text: None,
    progress: Progress = silent,
) -> Result:
    """Join several captures of one object, in `folder`/view01, view02, …, into a closed asset; extra [fusion].

    `out` is by default `folder`/fused; `workers` views are processed at a time. `config` is a
    `polcap.fusion.fusion_path.SessionConfig`, the settings of the views and of the fusion. `notify` is called with
    lines of text. The other arguments are those of `process`. A repeated call continues an interrupted one.

    Raises
    ------
    SettingError
        `folder` does not exist, or `config` is that of one view.
    PolcapError
        Its message is one line: the thing, its value, the limit and the remedy.
    """
    from polcap.fusion import fuse_run
    from polcap.fusion.fusion_path import SessionConfig
    from polcap.fusion.session_views import SessionInput

    chosen = config or SessionConfig()
    if not isinstance(chosen, SessionConfig):
        raise SettingError(f"config = {config!r:.60}: cannot be used; give a polcap.fusion.fusion_path.SessionConfig")
    place = Path(folder)
    resource_limits.set_limits(threads, memory)
    request = Request(
        config=chosen.of_views, chart=chart, estimator=estimator, model=None if model is None else Path(model),
        device=device, angles_deg=angles_deg, clockwise=clockwise, threads=threads, memory_gb=memory,
    )  # fmt: skip
    target = place / own_folders.FUSED if out is None else Path(out)
    about = fuse_run.fuse(SessionInput(place, chosen, request, workers), target, notify, progress)
    return Result(target, about)


def _names(stated: _Name | Sequence[_Name]) -> tuple[_Name, ...]:
    """Names as a tuple; a text alone is one name."""
    return (stated,) if isinstance(stated, str) else tuple(stated)


def _check_types(config: object, chart: object, mask: object) -> None:
    """Raise a SettingError for a value of another type, before anything is written."""
    for name, value, usable, remedy in (
        ("config", config, config is None or isinstance(config, Config), "give that of polcap.load_config(…)"),
        ("chart", chart, isinstance(chart, ChartRequest), 'give polcap.ChartRequest("none") or another one'),
        ("mask", mask, mask is None or np.ndim(np.asarray(mask)) == 2, "give an array (H, W), true on the object"),
    ):
        if not usable:
            raise SettingError(f"{name} = {value!r:.60}: cannot be used; {remedy}")
