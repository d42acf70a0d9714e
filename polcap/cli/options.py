"""Options that several commands share, and the functions that parse them."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from polcap import terminal
from polcap.errors import SettingError
from polcap.formats import own_folders

if TYPE_CHECKING:
    from polcap.formats.export.texture_set import Extra
    from polcap.images import ChartRequest


_NAMED = 5  # outdated exports that a warning lists


def result_folder(named: Path | None) -> Path | None:
    """The result folder that an argument names: itself, or the result in the folder of a capture or of views."""
    if named is None or any((named / name).exists() for name in ("work", "report.json", "maps")):
        return named
    for inside in (named / own_folders.OUTPUT, named / own_folders.FUSED):
        if (inside / "report.json").exists() or (inside / "work").is_dir():
            return inside
    return named


def choice(meaning: str) -> Any:
    """A command-line option with a fixed list of values; upper and lower case are equal."""
    return Option(case_sensitive=False, help=meaning)


def completion(names: Sequence[str]) -> Callable[[str], list[str]]:
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
_STAGES = completion(
    ("hdr", "whitebalance", "align", "mask", "selfcal", "stokes", "cues", "infer", "surface", "asset")
)  # those of pipeline.path, not imported at start
Until = Annotated[str | None, Option(metavar="STAGE", help="Stop after this stage.", autocompletion=_STAGES)]
Force = Annotated[
    str | None, Option(metavar="STAGE", help="Compute this stage and all after it again.", autocompletion=_STAGES)
]
Threads = Annotated[int, Option("--threads", "-j", min=0, help="Threads to use; 0 is all.")]
Memory = Annotated[float, Option(min=0, help="Most memory to take, GB; 0 is no limit.")]


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


def catalog_fields(stated: Sequence[str]) -> dict[str, str]:
    """Parse --about K=V: fields of `CatalogEntry` by name. Raises SettingError for an unknown field."""
    from polcap.images import CatalogEntry

    known = [field.name for field in fields(CatalogEntry)]
    for text in stated:
        if "=" not in text:
            raise SettingError(f'--about {text}: write FACT=TEXT, for example title="Vase with handles"')
    found = dict(text.partition("=")[::2] for text in stated)
    for key in found:
        if key not in known:
            raise SettingError(f"--about {key}: there is no such fact; there are {', '.join(known)}")
    return found


def warn_of_outdated_exports(out: Path, records: Sequence[Path]) -> None:
    """Print a warning if exports with these sidecars in a result folder, or files of them, have other maps or facts."""
    from polcap.formats import text_file
    from polcap.pipeline import asset_export

    old = asset_export.outdated(records, text_file.read_json(out / "report.json").get("keys", {}))
    if old:
        named = ", ".join([path.relative_to(out).as_posix() for path in old[:_NAMED]] + ["…"] * (len(old) > _NAMED))
        text = f"{named} in {out}: exported earlier, with other maps, settings or facts; export again, or remove"
        terminal.print_message(f"polcap: warning: {text}", "WARNING")


def extra_textures(named: Sequence[str]) -> "tuple[Extra, ...]":
    """Parse --extra: names of further textures. Raises SettingError for an unknown name."""
    from polcap.formats.export.texture_set import EXTRAS

    for name in named:
        if name not in EXTRAS:
            raise SettingError(f"--extra {name}: there is no such texture; there are {', '.join(EXTRAS)}")
    return tuple(extra for extra in EXTRAS if extra in named)


def texture_bits(bits: int | None) -> Literal[8, 16] | None:
    """Check --bits: 8 or 16. Raises SettingError for another number."""
    if bits not in (None, 8, 16):
        raise SettingError(f"--bits {bits}: PNG has 8 or 16 bits")
    return None if bits is None else 8 if bits == 8 else 16


def check_stages(named: Mapping[str, str | None]) -> None:
    """Raise a SettingError if an option names a stage that does not exist; the message names the option."""
    from polcap.pipeline.path import STAGES

    for flag, stage in named.items():
        if stage not in (None, *STAGES):
            raise SettingError(f"{flag} {stage}: no such stage; choose one of {', '.join(STAGES)}")


def chart_request(text: str | None, no_chart: bool) -> "ChartRequest":
    """Parse --chart and --no-chart: corners, a profile or no chart; by default the chart is searched for."""
    import numpy as np

    from polcap.formats import calibrations
    from polcap.images import ChartRequest

    if text is None:
        return ChartRequest("none" if no_chart else "auto")
    if no_chart:
        raise SettingError("--chart and --no-chart exclude each other; leave one out")
    if Path(text).suffix == ".toml":
        return ChartRequest("profile", profile=calibrations.read_profile(Path(text)))
    corners = numbers("--chart", text, "give 8 numbers, or a color profile that ends in .toml")
    if len(corners) != 8:
        raise SettingError(f"--chart gives {len(corners)} numbers; four corners have 8, a profile ends in .toml")
    return ChartRequest("corners", corners=np.reshape(corners, (4, 2)))


def measured_chart(config: Path | None, assignments: list[str] | None) -> str | None:
    """The setting whitebalance.chart, which may name a file; None if it is not stated or --config is no TOML."""
    from polcap.formats import text_file

    stated = [text.partition("=")[2].strip() for text in assignments or () if text.startswith("whitebalance.chart=")]
    if not stated and config is not None:
        try:
            stated = [str(text_file.read_toml(config)["whitebalance"]["chart"])]
        except (OSError, ValueError, KeyError, TypeError):
            return None
    return stated[-1] if stated else None


def user_mask(file: Path) -> Any:
    """Read the picture of --mask as (H, W) bool: true where it is lighter than half of white."""
    from polcap.formats.maps import png

    picture = png.read(file)
    half = 128 if picture.dtype.itemsize == 1 else 32768
    return (picture if picture.ndim == 2 else picture[..., :3].max(-1)) >= half


def training(module: str) -> Any:
    """Import a module of polcap.training. Raises SettingError where torch is not installed."""
    try:
        return import_module(f"polcap.training.{module}")
    except ModuleNotFoundError as error:
        raise SettingError(f"{error.name} is not installed; pip install 'polcap[train]'") from error
