"""`polcap fuse`: several captures of one object become one closed asset."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Option

from polcap import resource_limits, terminal
from polcap.cli import options
from polcap.errors import SettingError
from polcap.formats import own_folders

_NEEDED = ("embreex", "manifold3d", "skimage", "uvunwrap")  # packages of the extra [fusion]


def fuse(
    context: Context,
    folder: Annotated[Path, Argument(help="Folder with the captures view01, view02, … of one object on the board.")],
    out: Annotated[Path | None, Option("--out", "-o", help="Result folder; by default FOLDER/fused.")] = None,
    config: options.ConfigFile = None,
    assignments: options.Assignments = None,
    json: options.Json = False,
    open_: options.OpenPage = False,
    device: options.Device = "cpu",
    workers: Annotated[int, Option("--workers", "-j", min=1, help="Views at a time, each in a process.")] = 1,
    threads: options.ProcessThreads = 0,
    memory: options.ProcessMemory = 0,
    angles: options.Angles = None,
    clockwise: options.Clockwise = False,
    chart: options.Chart = None,
    no_chart: options.NoChart = False,
    estimator: options.Estimator = None,
    model: options.Model = None,
) -> None:
    """Join several captures of one object into a closed asset. Run again, it goes on where it was stopped."""
    from polcap.pipeline import unchanged

    stated = {**context.params, "config": config, "model": model}  # paths, not text
    target = out or folder / own_folders.FUSED
    asked = options.request_digest(stated, folder, target)
    if options.print_finished(target, asked, json, open_):
        return
    from polcap import config as settings
    from polcap.fusion import fuse_run
    from polcap.fusion.fusion_path import SessionConfig
    from polcap.fusion.session_views import SessionInput
    from polcap.pipeline import asset_export

    resource_limits.set_limits(threads, memory)
    if missing := [name for name in _NEEDED if find_spec(name) is None]:
        raise SettingError(f"polcap fuse needs {', '.join(missing)}: pip install 'polcap[fusion]'")
    chosen = settings.fill(SessionConfig, settings.read(config), assignments or [])
    request = options.request(stated, chosen.of_views)
    session_input = SessionInput(folder, chosen, request, workers)
    about = fuse_run.fuse(session_input, target, terminal.print_progress, terminal.Steps().stage)
    options.warn_of_outdated_exports(target, asset_export.sidecars(target))
    unchanged.remember(target, asked, files=request.files())
    terminal.print_result(about, target, json, open_)
