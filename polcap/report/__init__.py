"""The report of a run: figures and quality gates, written as report.json for programs and report.html for people.

A failed gate means that the asset was written but must be checked before use (exit code 3). A warning states an
assumption. A gate that had nothing to measure is marked "not measured".
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from polcap import __version__
from polcap.calibration_values import BallAccuracy
from polcap.capture_values import Capture, Frame
from polcap.config import Config
from polcap.errors import StorageError
from polcap.formats import atomic, text_file
from polcap.formats.capture import folder_names
from polcap.formats.export import provenance
from polcap.quality import error_maps, gates
from polcap.quality.advice import advise
from polcap.quality.gate_values import Gate, full_size
from polcap.report import chart_colors, figures, labels, page
from polcap.results import Results
from polcap.stage_values import Network

_PAGE_BYTES = 64 << 20  # largest page that is read; the page of the bundled capture has 3 MB


class _PhotographFacts(msgspec.Struct, frozen=True):
    file: str
    digest: str
    exposure_time: float | None = None


class _ShotFacts(msgspec.Struct, frozen=True):
    angle_deg: float
    frames: list[_PhotographFacts]


class _CaptureFacts(msgspec.Struct, frozen=True):
    name: str
    camera: str
    shots: list[_ShotFacts]
    lens: str = ""
    filter: str = ""
    ball: BallAccuracy | None = None
    catalog: dict[str, str] = {}
    focal_doubt: tuple[float, float] = (0.0, 0.0)
    upright_deg: Literal[0, 90, 180, 270] = 0


class RunFacts(msgspec.Struct, frozen=True):
    """Facts of a run that do not come from its pixels, with the fields that commands rely on."""

    capture: _CaptureFacts
    settings: dict[str, dict[str, Any]]
    model: dict[str, str] | None
    versions: dict[str, str]


class _ReportFile(RunFacts, frozen=True, kw_only=True):
    """Fields of report.json that commands rely on; `read` checks them, because another version may have written it."""

    polcap: str
    verdict: Literal["pass", "warn", "fail"]
    expected_error_deg: float | None = None
    gates: list[Gate]
    figures: dict[str, dict[str, Any]]
    keys: dict[str, str]


def capture_facts(capture: Capture) -> dict[str, Any]:
    """Camera, angles and photographs of a capture, as report.json has them."""
    shots, first = [], capture.shots[0].frames[0].exif
    for shot in capture.shots:
        frames = [_frame_facts(frame, capture) for frame in shot.frames]
        shots.append({"angle_deg": round(float(np.degrees(shot.angle)), 6), "frames": frames})
    return {
        "name": capture.name,
        "folder": capture.folder,
        "layout": capture.layout,
        "camera": first.camera,
        "serial": first.serial,
        "lens": first.lens,
        "filter": capture.lens_filter,
        "ball": None if capture.accuracy is None else msgspec.to_builtins(capture.accuracy),
        "taken": first.taken,
        "size_px": list(capture.size_px),
        "upright_deg": capture.upright_deg,
        "focal_px": capture.focal_px,
        "focal_known": capture.focal_known,
        "focal_doubt": list(capture.focal_doubt),
        "shots": shots,
        "notes": list(capture.notes),
        "catalog": {key: text for key, text in msgspec.structs.asdict(capture.catalog).items() if text},
    }


def _frame_facts(frame: Frame, capture: Capture) -> dict[str, Any]:
    stated = {name: getattr(frame.exif, name) for name in ("exposure_time", "iso", "f_number")}
    return {"file": capture.file_name(frame), **stated, "digest": frame.digest}


def judge(facts: Mapping[str, Any], results: Results, config: Config) -> tuple[list[Gate], Results]:
    """Judge a result by the gates, and give its maps expected errors that include the costs of all gates."""
    files = tuple(tuple(frame["file"] for frame in shot["frames"]) for shot in facts["capture"]["shots"])
    focal_doubt = tuple(facts["capture"].get("focal_doubt", (0.0, 0.0)))
    evidence = full_size(results, focal_doubt, config.align, files)
    judged = advise(gates.judge(evidence, config.gates))
    maps = error_maps.with_errors(evidence, judged)
    return judged, replace(results, maps=maps)


def document(
    facts: Mapping[str, Any], results: Results, judged: Sequence[Gate], config: Config, timings: Mapping[str, float]
) -> dict[str, Any]:
    """Assemble the content of report.json: facts of the run, figures, gates, computing time of each stage [s]."""
    measured = {**figures.measure(results), "rerendering": figures.rerendering(results, config.infer.ior)}
    chart = config.whitebalance.chart
    expected = [gate.value for gate in judged if gate.name == "normal error" and isinstance(gate.value, float)]
    measured["chart"]["reference_sha256"] = chart_colors.digest(chart)
    return {
        "polcap": __version__,
        "versions": facts["versions"],
        "verdict": gates.verdict(judged),
        "expected_error_deg": next(iter(expected), None),
        "capture": facts["capture"],
        "gates": msgspec.to_builtins(judged),
        "figures": measured,
        "patches": chart_colors.patches(results.radiance, results.color, chart),
        "units": labels.units(bool(measured["mesh"]["metric"])),
        "timings": dict(timings),
        "model": facts["model"],
        "keys": dict(results.keys),
        "settings": facts["settings"],
    }


def session_document(
    name: str, captures: Mapping[str, Mapping[str, Any]], judged: Sequence[Gate], others: Mapping[str, Any]
) -> dict[str, Any]:
    """Assemble the content of report.json of several views: facts of their `captures`, gates, and `others`.

    Its shots are those of all views, with files named from the session's folder.
    """
    shots = [
        {**shot, "frames": [{**frame, "file": f"{view}/{frame['file']}"} for frame in shot["frames"]]}
        for view, capture in captures.items()
        for shot in capture["shots"]
    ]
    return {
        "polcap": __version__,
        "versions": provenance.versions(),
        "verdict": gates.verdict(judged),
        "capture": {**next(iter(captures.values())), "name": name, "shots": shots},
        "gates": msgspec.to_builtins(judged),
        **others,
    }


def model_facts(network: Network | None) -> dict[str, str] | None:
    """Metadata and digest of the estimator's network and of its refinement network; None: the analytic estimator."""
    if network is None:
        return None
    refinement = {} if network.fine is None else {"fine": network.fine.digest}
    return {**network.metadata, "digest": network.digest, **refinement}


def write(folder: Path, about: dict[str, Any], results: Results) -> None:
    """Write report.json and report.html into a result folder."""
    atomic.write_json(folder / "report.json", about)
    page.write(folder, about, results)


def archive(
    out: Path, folder: Path, about: Mapping[str, Any], entry: Mapping[str, str], assets: str = ""
) -> list[Path]:
    """Write report.json and report.html of the result `out` into an archive, with its catalog facts; returns the files.

    `about` is the content of report.json, `entry` has the stated fields of `CatalogEntry`. `assets` is the path from
    the page to the GLB's folder, "" or with a slash at its end. A result without a page gets none.

    Raises StorageError: the page is a link or not that of this polcap, or cannot be read.
    """
    files, source = [folder / "report.json"], out / "report.html"
    stated = {**about, "capture": {**about["capture"], "catalog": dict(entry)}}
    atomic.write_json(files[0], stated)
    if source.is_symlink():
        raise StorageError(f"{source} is a link; remove it, and write the page again by `polcap process`")
    if source.exists():
        try:
            glb = f"{assets}{about['capture']['name']}.glb"
            text = page.archived(text_file.read_text(source, _PAGE_BYTES), stated, glb)
        except (OSError, ValueError) as error:
            raise StorageError(f"{source} cannot be read ({error}); write it again by `polcap process`") from error
        files.append(folder / source.name)
        atomic.write(files[1], text)
    return files


def read(folder: Path) -> dict[str, Any]:
    """Read the report.json of a result folder.

    Raises StorageError: the file is missing, it is not a report of this version, or maps/ is of another run.
    """
    try:
        about: dict[str, Any] = text_file.read_json(folder / "report.json")
        msgspec.convert(about, _ReportFile)
    except OSError as error:
        if any((folder / part).is_dir() for part in ("work", "maps")):
            raise StorageError(f"{folder} holds no report.json; run `polcap process` first") from error
        raise StorageError(folder_names.without_result(folder)) from error
    except ValueError as error:
        text = f"{folder / 'report.json'} is no report of this polcap ({error}); run `polcap process` again"
        raise StorageError(text) from error
    if _keys_of_maps(folder) not in (None, about["keys"]):
        raise StorageError(f"{folder}: maps/ and report.json are of two runs; run `polcap process` again")
    return about


def _keys_of_maps(folder: Path) -> Any:
    """The cache keys with which maps/ was written; None if there is no maps.json."""
    try:
        return text_file.read_json(folder / "maps" / "maps.json")["keys"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
