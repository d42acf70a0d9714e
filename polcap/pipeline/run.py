"""Processes a capture: runs the path, writes maps and asset, judges, reports; also opens a finished result again.

The order of the stages is in `path.py`.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import msgspec

from polcap import parallel, report
from polcap.capture_values import Capture, Decode, Frame
from polcap.config import Config, restore
from polcap.errors import InputError, SettingError, StorageError
from polcap.formats import color_profile, own_files, own_folders
from polcap.formats.export import encoders, provenance
from polcap.formats.maps import maps_folder, png
from polcap.formats.raw import frame_decoder
from polcap.image_values import SensorImage
from polcap.pipeline import (
    asset_export,
    detail_levels,
    early_end,
    export_request,
    result_folder,
    result_place,
    run_facts,
    unchanged,
)
from polcap.pipeline.cache import ArchiveCache, DryRunCache, Progress, StageCache, silent
from polcap.pipeline.export_request import ExportRequest
from polcap.pipeline.manifest import contents
from polcap.pipeline.path import UserInput, path
from polcap.report import animation
from polcap.report import stage_pictures as pictures
from polcap.results import STAGES, FirstResults, R, Results, kind_until

ASSET = STAGES[-1]  # made after the path, from the files in maps/


def process(
    capture: Capture,
    supplied: UserInput,
    config: Config,
    out: Path,
    until: str | None = None,
    force: str | None = None,
    progress: Progress = silent,
) -> dict[str, Any] | None:
    """Process a capture into the result folder `out`; returns the content of report.json.

    None if it ended after the stage `until` of the path, without an asset.

    Raises InputError: the user's input is wrong; the stage that found it raises the error.
    """
    cache = StageCache(out, progress, force)
    with opened(capture, supplied, config, cache) as facts:
        if until in (None, ASSET):
            result_folder.check_edits(out)
        try:
            results = path(capture, supplied, config, cache, kind_until(until or ASSET))
        except InputError as error:
            if (explained := early_end.explain(error, cache, capture, config)) is None:
                raise
            raise explained from error
        if until not in (None, ASSET):
            return None
        assert isinstance(results, Results)
        cache.begin(ASSET)
        about = _write(out, results, facts, config)
        cache.end()
        return about


def process_once(capture: Capture, supplied: UserInput, config: Config, out: Path) -> dict[str, Any]:
    """As `process`, unless `out` already holds the finished result of the same inputs, and no file of it has changed.

    Raises InputError: as `process`.
    """
    keys = path(capture, supplied, config, DryRunCache(out), Results).keys
    request = unchanged.request_of_run([_facts(capture, supplied, config), keys])
    if (finished := unchanged.find(out, request)) is not None:
        return finished.report
    about = process(capture, supplied, config, out)
    assert about is not None  # only `until` leaves it out
    unchanged.remember(out, request)
    return about


@contextmanager
def opened(capture: Capture, supplied: UserInput, config: Config, cache: StageCache) -> Iterator[dict[str, Any]]:
    """Context manager that locks the result folder of a cache and writes its work/run.json; returns its facts.

    Raises SettingError: the folder is not allowed, or memory is too small. StorageError: it is locked.
    """
    result_place.check(cache.folder, Path(capture.folder))
    with cache.memory_explained(capture.size_px[0] * capture.size_px[1]), result_folder.locked(cache.folder):
        facts = _facts(capture, supplied, config)
        run_facts.write(cache.folder, facts)
        yield facts


def _facts(capture: Capture, supplied: UserInput, config: Config) -> dict[str, Any]:
    """Facts of a run as report.json has them, which do not come from pixels."""
    return {
        "capture": report.capture_facts(capture),
        "settings": msgspec.to_builtins(config),
        "model": report.model_facts(supplied.network),
        "versions": provenance.versions(),
    }


def _write(out: Path, results: Results, facts: dict[str, Any], config: Config) -> dict[str, Any]:
    """Write maps, asset, color profile and report of a finished path; returns the content of report.json.

    Files are encoded while figures are measured and the page is drawn: encoders alone do not fill two cores.
    """
    judged, results = report.judge(facts, results, config)
    results = replace(results, keys={**results.keys, ASSET: asset_export.key(results.keys, config.asset)})
    about, _ = parallel.both(
        partial(report.document, facts, results, judged, config, timings(out)),
        partial(maps_folder.write, out / "maps", results),
    )
    parallel.both(
        partial(report.write, out, about, results),
        lambda: asset_export.write(out, about, ExportRequest(), detail_levels.read(out / "maps", config, results.mesh)),
    )
    profile = out / color_profile.NAME
    if results.color.source in ("chart", "corners"):
        color_profile.write(profile, results.color)
    elif results.color.source != "profile" and (own := own_files.owner(profile)):  # --chart may name this file
        own.remove(profile)
    return about


def decode_with_progress(capture: Capture, frame_read: Callable[[int, int], None]) -> Decode:
    """A decode function that reports progress by `frame_read`: numbers of decoded and of all photographs of shots."""
    total, number = sum(len(shot.frames) + len(shot.ambient) for shot in capture.all_shots), count(1)

    def decode(frame: Frame) -> SensorImage:
        image = frame_decoder.decode(frame)
        frame_read(min(next(number), total), total)  # frames that left memory are decoded again
        return image

    return decode


def plan(capture: Capture, supplied: UserInput, config: Config, out: Path, force: str | None = None) -> dict[str, str]:
    """Dry run of `process`: whether each stage is cached, to compute, or on demand. Nothing is computed."""
    cache = DryRunCache(out, force)
    path(capture, supplied, config, cache, Results)
    return {**cache.states, ASSET: "on demand"}


def export(out: Path, *wanted: ExportRequest) -> list[Path]:
    """Write the asset of a finished result again for each request, from maps/ and report.json; returns the files.

    Raises SettingError: a preset or color space does not exist, or a package or encoder is missing.
    """
    for one in wanted:
        export_request.check(one)
    return asset_export.again(out, wanted, Config, detail_levels.read)


def reopen(out: str | Path, wanted: type[R]) -> tuple[R, dict[str, Any]]:
    """Read the `wanted` results of an earlier run, without its photographs, and the facts in work/run.json.

    Raises StorageError: `out` has no stage cache, or the result of a stage is missing.
    """
    out = own_folders.find_result(Path(out))
    about = run_facts.read(out)
    config = restore(Config, about, out / "work" / "run.json")
    return path(None, UserInput(), config, ArchiveCache(out), wanted), about


def show(out: Path, stages: Sequence[str]) -> list[Path]:
    """Write pictures of the results of these stages; returns the PNGs' paths."""
    for stage in stages:
        if stage not in STAGES:
            raise SettingError(f"{stage!r} is no stage; choose one of {', '.join(STAGES)}")
    results, _ = reopen(out, kind_until(max(stages, key=STAGES.index)))
    drawn = []
    with result_folder.opened(out):
        for stage in stages:
            drawn.append(out / "work" / f"{stage}.png")
            png.write(drawn[-1], _textures(out, results) if stage == ASSET else pictures.of_stage(results, stage))
    return drawn


def _textures(out: Path, results: FirstResults) -> pictures.Picture:
    """Picture of the textures of a finished result's asset. Raises StorageError: as `_report_of`."""
    assert isinstance(results, Results)
    config = restore(Config, _report_of(out, results), out / "report.json")
    return pictures.textures(detail_levels.read(out / "maps", config, results.mesh).whole(8, ()))


def _report_of(out: Path, results: FirstResults) -> dict[str, Any]:
    """The report.json of a finished result. Raises StorageError: it is not finished, or work/ is of another run."""
    about = report.read(out)
    if any(about["keys"].get(stage) != key for stage, key in results.keys.items()):
        raise StorageError(f"{out}: work/ and maps/ are of two runs; run `polcap process` again")
    return about


def animate(out: Path, motion: animation.Motion) -> list[Path]:
    """Write an animation with a moving light or object; returns the paths of the WebP and, with FFmpeg, of the MP4."""
    results, about = reopen(out, Results)
    ior = float(about["settings"]["infer"]["ior"])
    turning = motion == "turntable"
    frames = animation.turntable(results.maps, results.mesh, ior) if turning else animation.light(results.maps, ior)
    with result_folder.opened(out):
        return encoders.animate(out / "work" / motion, frames, animation.SECONDS)


def judge_again(out: Path) -> dict[str, Any]:
    """Judge a finished result again from the stage cache: writes report.json and report.html.

    Raises StorageError: a stage's result is missing, or work/, maps/ and report.json are not of one run.
    """
    results, facts = reopen(out, Results)
    with result_folder.locked(out), unchanged.preserved(out):
        keys = _report_of(out, results)["keys"]
        config = restore(Config, facts, out / "work" / "run.json")
        judged, results = report.judge(facts, results, config)
        about = report.document(facts, results, judged, config, timings(out))
        about["keys"] = keys
        report.write(out, about, results)
    return about


def timings(out: Path) -> dict[str, float]:
    """Computing time [s] of each stored stage, from when it was computed."""
    return {about["stage"]: about["seconds"] for about in contents(out)}
