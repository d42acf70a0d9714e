"""Options that several commands share, and the functions that parse them."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from polcap import terminal
from polcap.errors import SettingError, package_for
from polcap.formats import own_folders
from polcap.results import STAGES

if TYPE_CHECKING:
    from polcap.chart_values import ChartRequest
    from polcap.config import Config
    from polcap.pipeline.request import Request

    Stage = str
else:
    Stage = Literal[STAGES]

_LISTED = 5  # files that a warning lists
# options without effect on the bytes of a result
_NO_EFFECT = ("capture", "folder", "out", "json", "dry_run", "watch", "open_", "workers", "threads", "memory")


def result_folder(named: Path | None) -> Path | None:
    """The result folder that an argument names, as `own_folders.find_result`."""
    return None if named is None else own_folders.find_result(named)


def check_out(named: Path | None) -> None:
    """Raise a SettingError for a folder --out that holds photographs or lies among those of a capture."""
    from polcap.pipeline import result_place

    if named is not None:
        result_place.check_free(named)


def utf8(option: str, text: str) -> str:
    """The text of an option that is written into files. Raises SettingError: it is not UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise SettingError(f"{option} {text}: is not UTF-8 text; set the terminal to UTF-8, or write ASCII") from None
    return text


def choice(meaning: str, metavar: str | None = None) -> Any:
    """A command-line option with a fixed list of values; `metavar` replaces them in the help."""
    return Option(case_sensitive=False, help=meaning, metavar=metavar)


def completion(names: Collection[str]) -> Callable[[str], list[str]]:
    """A function that completes values of an option in the shell: those of `names` with the typed beginning."""
    return lambda incomplete: [name for name in names if name.startswith(incomplete.lower())]


Result = Annotated[
    Path, Argument(help="Result folder of `polcap process`, or the capture that holds it.", callback=result_folder)
]
CaptureFolder = Annotated[Path, Argument(help="Folder with the photographs.")]
Json = Annotated[bool, Option("--json", help="One JSON document on stdout.")]
OpenPage = Annotated[bool, Option("--open", help="Open the report in the browser at the end.")]
ConfigFile = Annotated[Path | None, Option(help="TOML file of settings, a section per stage.")]
Assignments = Annotated[
    list[str] | None, Option("--set", metavar="K=V", help="A setting, such as hdr.clip=0.95; repeatable.")
]
Angles = Annotated[str | None, Option(metavar="DEG,…", help="Angles of the shots in order, such as 0,45,90.")]
Clockwise = Annotated[bool, Option("--clockwise", help="The ring was turned clockwise as seen in the picture.")]
_CHART = "Chart corners in RAW px, dark skin first, clockwise; or a color profile."
Chart = Annotated[str | None, Option(metavar="X0,Y0,…|FILE", help=_CHART)]
NoChart = Annotated[bool, Option("--no-chart", help="Use the camera's own colors.")]
_ESTIMATOR = "How normals and materials are estimated; by default by the network."
Estimator = Annotated[Literal["network", "analytic"] | None, choice(_ESTIMATOR)]
Model = Annotated[Path | None, Option(metavar="ONNX", help="A model of your own instead of the shipped one.")]
_DEVICE = "Where the network runs; cuda fails where CUDA does not start."
Device = Annotated[Literal["cpu", "cuda", "auto"], choice(_DEVICE)]
Until = Annotated[Stage | None, choice("Stop after this stage.", "STAGE")]
Force = Annotated[Stage | None, choice("Compute this stage and all after it again.", "STAGE")]
Threads = Annotated[int, Option("--threads", "-j", min=0, help="Threads to use; 0 is all.")]
Memory = Annotated[float, Option(min=0, help="Most memory to take, GB; 0 is no limit.")]
ProcessThreads = Annotated[int, Option("--threads", min=0, help="Threads per process; 0 is all.")]  # -j: --workers
ProcessMemory = Annotated[float, Option("--memory", min=0, help="Most memory per process, GB; 0 is no limit.")]


def angles_deg(text: str | None) -> tuple[float, ...] | None:
    """Parse --angles, in degrees; None without it."""
    return None if text is None else numbers("--angles", text, "write 0,45,90")


def numbers(flag: str, text: str, remedy: str) -> tuple[float, ...]:
    """Parse a comma-separated list of finite numbers of an option `flag`; `remedy` ends the error's message."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise SettingError(f"{flag} {text}: not numbers separated by commas; {remedy}") from None
    if not all(map(math.isfinite, found)):
        raise SettingError(f"{flag} {text}: every number must be finite")
    return found


def warn_of_outdated_exports(out: Path, records: Sequence[Path]) -> None:
    """Print a warning if exports with these sidecars in a result folder, or files of them, have other maps or facts."""
    from polcap.formats import text_file
    from polcap.pipeline import asset_export

    old = asset_export.find_outdated(out, records, text_file.read_json(out / "report.json").get("keys", {}))
    if old:
        named = ", ".join([path.relative_to(out).as_posix() for path in old[:_LISTED]] + ["…"] * (len(old) > _LISTED))
        why = "exported earlier, under another name or with other maps, settings or facts"
        text = f"{named} in {out}: {why}; export again, or remove"
        terminal.print_message(f"polcap: warning: {text}", "WARNING")


def warn_of_altered_archive(folder: Path) -> None:
    """Print a warning if a folder is an archive and files of it differ from its manifest."""
    from polcap.formats import own_folders
    from polcap.formats.export import archive

    if changed := archive.altered(folder):
        named = ", ".join(changed[:_LISTED] + ["…"] * (len(changed) > _LISTED))
        text = f"{named} in {folder}: missing, or not as in {own_folders.MANIFEST}; take another copy of the archive"
        terminal.print_message(f"polcap: warning: {text}", "WARNING")


def chart_request(text: str | None, no_chart: bool) -> "ChartRequest":
    """Parse --chart and --no-chart: corners, a profile or no chart; by default the chart is searched for."""
    import numpy as np

    from polcap.chart_values import ChartRequest
    from polcap.formats import color_profile

    if text is None:
        return ChartRequest("none" if no_chart else "auto")
    if no_chart:
        raise SettingError("--chart and --no-chart exclude each other; leave one out")
    if Path(text).suffix == ".toml":
        return ChartRequest("profile", profile=color_profile.read(Path(text)))
    corners = numbers("--chart", text, "give 8 numbers, or a color profile that ends in .toml")
    if len(corners) != 8:
        raise SettingError(f"--chart gives {len(corners)} numbers; four corners have 8, a profile ends in .toml")
    return ChartRequest("corners", corners=np.reshape(corners, (4, 2)))


def request_digest(stated: Mapping[str, Any], folder: Path, out: Path) -> str | None:
    """Digest of a run on the photographs of a folder for `unchanged.find`, from its options by name."""
    from polcap.pipeline import unchanged

    asked = {name: value for name, value in stated.items() if name not in _NO_EFFECT}
    named = [stated.get(name) for name in ("config", "mask", "model", "chart")]
    files = [Path(name) for name in named if name is not None and Path(name).is_file()]
    return unchanged.request(asked, folder, out, files)


def request(stated: Mapping[str, Any], config: "Config") -> "Request":
    """The request that options state, by their names, with parsed paths; options that a command lacks are not stated.

    Raises SettingError: an option, or a file that it names, is wrong.
    """
    from polcap.pipeline.request import Request

    shared = ("estimator", "model", "device", "clockwise", "threads")  # names of options and of fields
    mask = stated.get("mask")
    return Request(
        config=config,
        chart=chart_request(stated["chart"], stated["no_chart"]),
        mask=None if mask is None else user_mask(mask),
        angles_deg=angles_deg(stated["angles"]),
        memory_gb=stated.get("memory", 0.0),
        **{name: stated[name] for name in shared if name in stated},
    )


def print_finished(out: Path, asked: str | None, json: bool, open_: bool) -> bool:
    """Whether a result folder already answers this request digest; its result is then printed.

    Raises GateError: one of its gates failed.
    """
    from polcap.pipeline import unchanged

    finished = unchanged.find(out, asked)
    if finished is not None:
        terminal.print_progress(f"{finished.table}\nNothing has changed since the last run.".lstrip())
        terminal.print_result(finished.report, out, json, open_)
    return finished is not None


def user_mask(file: Path) -> Any:
    """Read the picture of --mask as (H, W) bool: true where it is lighter than half of white."""
    from polcap.formats.maps import png

    picture = png.read(file)
    half = 128 if picture.dtype.itemsize == 1 else 32768
    return (picture if picture.ndim == 2 else picture[..., :3].max(-1)) >= half


def training(module: str) -> Any:
    """Import a module of polcap.training. Raises SettingError where torch is not installed."""
    with package_for("training", "PyTorch, onnx, embreex and Pillow", "train"):
        return import_module(f"polcap.training.{module}")
