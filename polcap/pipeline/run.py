"""In: a capture and what the user gives with it. Out: its maps, its asset and the verdict on them, in files.

The stages and their order stand in `path.py`; this is what surrounds them: locks, result folders, reports.
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from polcap import report, resource_limits
from polcap.config import Config, restored
from polcap.errors import InputError, SettingError, StorageError
from polcap.formats import atomic, calibrations, text_file
from polcap.formats.capture import layouts
from polcap.formats.export import animation, provenance
from polcap.formats.maps import maps_folder, png
from polcap.formats.written import Written
from polcap.images import Capture, ColorCalibration, Frame, Network, SensorImage, Shot
from polcap.parallel import Beside, finished
from polcap.pipeline import asset_export, unchanged
from polcap.pipeline.asset_export import Wanted
from polcap.pipeline.cache import Archive, Progress, Store, contents, seal, silent
from polcap.pipeline.path import STAGES, Results, UserInput, path
from polcap.remembered import Remembered
from polcap.report import moving, page
from polcap.report import stage_pictures as pictures

PROFILE = "color.toml"  # beside the report


def process(
    capture: Capture,
    supplied: UserInput,
    config: Config,
    out: Path,
    until: str | None = None,
    force: str | None = None,
    progress: Progress = silent,
    frame_read: Callable[[int, int], None] | None = None,
) -> dict[str, Any] | None:
    """Run the path and write the result folder; returns report.json's content, None with `until`.

    `frame_read` is told how many of how many photographs have been decoded.

    Raises
    ------
    InputError
        Anything at fault with what the user gave, from the stage that saw it.
    """
    _check_out(out, Path(capture.folder))
    work = _Work(progress)
    try:
        return _processed(capture, supplied, config, out, until, force, work, frame_read)
    except Exception as error:
        if not resource_limits.is_shortfall(error):
            raise
        raise resource_limits.shortfall(error, work.stage, capture.size_px[0] * capture.size_px[1]) from error


def _processed(
    capture: Capture,
    supplied: UserInput,
    config: Config,
    out: Path,
    until: str | None,
    force: str | None,
    progress: Progress,
    frame_read: Callable[[int, int], None] | None,
) -> dict[str, Any] | None:
    store = Store(out, progress, force)
    with store.lock():
        sweep(out)
        results = path(_counted(capture, frame_read), supplied, config, store)
        _remember_run(out, capture, config, supplied.network)
        if until is not None:
            store.materialize(until)
            return None
        written, remembered = _kept(out, force is not None)
        before = None
        if force is None:
            before = _written_before(written, out, capture, config, supplied.network, results)
        if before is not None:
            store.materialize()
            progress("write", 0.0, True)
            return before
        with Beside() as beside:
            if not results.radiance.ready:
                beside.begin(partial(_warm, supplied))
            store.materialize(results.maps.name)
        with maps_folder.writing(out / "maps", written) as files:
            files.begin({"maps": results.maps, "stokes": results.stokes, "cues": results.cues})
            store.materialize(after=results.maps.name)
            progress("write", None, False)
            start = time.perf_counter()
            files.begin({"mesh": results.mesh})
            facts = report.capture_facts(capture)
            about = report.document(facts, results, config, supplied.network, timings(out), remembered)
            files.finish()
        with Beside() as beside:
            drawn = [beside.begin(piece) for piece in page.pieces(about, results, remembered).values()]
            asset_export.export(out, about, Wanted(), written, results)
            finished(drawn)
        report.write(out, about, results, remembered)
        _write_profile(out / PROFILE, results.color.value)
        written.remember()
        progress("write", time.perf_counter() - start, False)
    return about


def _warm(supplied: UserInput) -> None:
    """Load what later stages need, while the merge waits for photographs; what fails here fails there again."""
    import scipy.special  # noqa: F401 — .2 s

    import polcap.optics.colour_science  # noqa: F401 — .2 s

    for network in (supplied.mask_network, supplied.network, supplied.network and supplied.network.fine):
        if network is not None:
            network.warm()


def _write_profile(file: Path, color: ColorCalibration) -> None:
    """What `--chart FILE.toml` of other captures takes, where this one's chart was read."""
    if color.source in ("chart", "corners"):
        calibrations.write_profile(file, color)
    else:
        file.unlink(missing_ok=True)


class _Work:
    """Passes progress on, and knows which stage was begun last."""

    def __init__(self, progress: Progress) -> None:
        self.stage, self._progress = "start", progress

    def __call__(self, name: str, seconds: float | None, cached: bool) -> None:
        if seconds is None:
            self.stage = name
        self._progress(name, seconds, cached)


def plan(capture: Capture, supplied: UserInput, config: Config, out: Path, force: str | None = None) -> dict[str, str]:
    """What `process` would do with each stage, without doing it: cached, compute, or on demand."""
    store = Store(out, force=force)
    path(capture, supplied, config, store)
    return {kept.name: "on demand" if not kept.keep else "cached" if kept.ready else "compute" for kept in store.steps}


def export(out: Path, wanted: Wanted) -> list[Path]:
    """The asset again, from maps/ and report.json alone; returns the files.

    Raises
    ------
    SettingError
        What is wanted does not exist, or needs what is not installed.
    """
    about = report.read(out)
    with Store(out).lock():
        sweep(out)
        return asset_export.export(out, about, wanted)


def reopen(out: Path) -> tuple[Results, dict[str, Any]]:
    """The results of an earlier run, without its photographs, and what was remembered of that run.

    Raises
    ------
    StorageError
        `out` holds no stage cache.
    """
    file = out / "work" / "run.json"
    try:
        about = text_file.read_json(file)
    except (OSError, ValueError) as error:
        raise StorageError(f"{out} holds no stage cache of this polcap; run `polcap process` again") from error
    if not isinstance(about, dict) or about.get("digest") != seal(about):
        raise StorageError(f"{file} is damaged, or of another polcap; run `polcap process` again")
    return path(None, UserInput(), restored(about, file), Archive(out)), about


def show(out: Path, stages: Sequence[str]) -> list[Path]:
    """Draw what stages made; returns the PNGs' paths."""
    for stage in stages:
        if stage not in STAGES:
            raise SettingError(f"{stage!r} is no stage; choose one of {', '.join(STAGES)}")
    results, _ = reopen(out)
    drawn = []
    for stage in stages:
        drawn.append(out / "work" / f"{stage}.png")
        png.write(drawn[-1], pictures.of_stage(results, stage))
    return drawn


def animate(out: Path, motion: moving.Motion) -> list[Path]:
    """Move the light or the object; returns the paths of the WebP and, where FFmpeg is present, the MP4."""
    results, about = reopen(out)
    ior = float(about["settings"]["infer"]["ior"])
    maps = results.maps.value
    frames = moving.light(maps, ior) if motion == "light" else moving.turntable(maps, results.mesh.value, ior)
    written = [out / "work" / f"{motion}.webp"]
    animation.webp(written[0], frames, moving.SECONDS)
    if animation.encoder():
        written.append(out / "work" / f"{motion}.mp4")
        animation.mp4(written[1], frames, moving.SECONDS)
    return written


def judge_again(out: Path) -> dict[str, Any]:
    """report.json and report.html anew from the stage cache."""
    results, about = reopen(out)
    with Store(out).lock():
        config = restored(about, out / "work" / "run.json")
        fixed = {name: about[name] for name in ("model", "versions")}
        nothing = Remembered()
        again = report.document(about["capture"], results, config, None, timings(out), nothing) | fixed
        if (out / "report.json").exists():
            again["keys"] = report.read(out).get("keys", {})
        report.write(out, again, results, nothing)
    return again


def timings(out: Path) -> dict[str, float]:
    """Seconds that each kept stage took when it was computed."""
    return {about["stage"]: about["seconds"] for about in contents(out)}


def sweep(out: Path) -> None:
    """Remove what a killed run left half written; final names are whole by construction."""
    for place in (out, out / "maps", out / "asset", *(out / "asset").glob("*/")):
        for left in place.glob(".*.part*"):
            atomic.discard(left)


def _check_out(out: Path, photographs: Path) -> None:
    """The result never lands among the photographs, nor where a later run would look for some; every format can go."""
    try:
        os.fspath(out).encode()
    except UnicodeEncodeError:
        raise SettingError(f"--out {out} is no UTF-8 text, as OpenEXR wants it; name another with --out") from None
    here, there = Path(os.path.realpath(out)), Path(os.path.realpath(photographs))
    if here == there:
        raise SettingError(f"--out {out} is the capture itself; choose a folder of its own")
    inside = here.relative_to(there).parts if here.is_relative_to(there) else ()
    if any(layouts.is_angle_folder(name) for name in inside):
        raise SettingError(f"--out {out} lies among the capture's shots; choose {photographs / layouts.OUTPUT}")


def _counted(capture: Capture, frame_read: Callable[[int, int], None] | None) -> Capture:
    """The capture with frames that tell when they have been decoded."""
    if frame_read is None:
        return capture
    brackets = [*capture.shots, *(() if capture.crossed is None else (capture.crossed,))]
    return _Counted(sum(len(shot.frames) for shot in brackets), frame_read).capture(capture)


class _Counted:
    """Counts the photographs of a capture as they are decoded."""

    def __init__(self, total: int, tell: Callable[[int, int], None]) -> None:
        self._total, self._tell, self._done = total, tell, 0

    def capture(self, capture: Capture) -> Capture:
        crossed = None if capture.crossed is None else self._shot(capture.crossed)
        return replace(capture, shots=tuple(map(self._shot, capture.shots)), crossed=crossed)

    def _shot(self, shot: Shot) -> Shot:
        return replace(shot, frames=tuple(map(self._frame, shot.frames)))

    def _frame(self, frame: Frame) -> Frame:
        return replace(frame, load=partial(self._load, frame.load))

    def _load(self, load: Callable[[], SensorImage]) -> SensorImage:
        image = load()
        self._done = min(self._done + 1, self._total)
        self._tell(self._done, self._total)
        return image


def _kept(out: Path, anew: bool) -> tuple[Written, Remembered]:
    """What an earlier run wrote and measured; nothing where it is not clear whether this program did."""
    program = unchanged.known_program()
    anew = anew or program is None
    return Written(out, program or "", anew), Remembered(out, program or "", anew)


def _written_before(
    written: Written, out: Path, capture: Capture, config: Config, network: Network | None, results: Results
) -> dict[str, Any] | None:
    """The report of an earlier run that would write the same files, where nobody has touched these since."""
    if not written.untouched():
        return None
    try:
        about = report.read(out)
    except InputError:
        return None
    same: dict[str, Any] = {
        "capture": report.capture_facts(capture),
        "versions": provenance.versions(),
        "model": report.model_facts(network),
        "keys": {kept.name: kept.key for kept in vars(results).values()},
        "settings": msgspec.to_builtins(config),
    }
    return about if json.loads(json.dumps(same)) == {name: about.get(name) for name in same} else None


def _remember_run(out: Path, capture: Capture, config: Config, network: Network | None) -> None:
    """work/run.json: what `show` and `report` need when the photographs are gone."""
    about = {
        "capture": report.capture_facts(capture),
        "settings": msgspec.to_builtins(config),
        "model": report.model_facts(network),
        "versions": provenance.versions(),
    }
    text = json.dumps({**about, "digest": seal(about)}, indent=1)
    with atomic.path(out / "work" / "run.json", synced=False) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
