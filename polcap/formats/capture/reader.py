"""Reads a capture folder: shots, brackets, camera, lens and calibration, checked; and prints them as a table."""

import math
import os
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Literal

import msgspec

from polcap.calibration_values import Calibration
from polcap.capture_values import AngleStatement, Capture, Exif, Frame, FrameReading, Shot
from polcap.errors import CaptureError, SettingError
from polcap.formats import atomic, ball_accuracies, calibrations
from polcap.formats.capture import capture_toml, focal_length, folder_names, layouts, unequal_brackets, unfinished
from polcap.formats.capture.capture_toml import CaptureFile
from polcap.formats.capture.focal_length import FocalLength
from polcap.formats.capture.layouts import Source
from polcap.formats.capture.unequal_brackets import same_exposure
from polcap.formats.raw import photo
from polcap.formats.raw.color_encoding import ColorEncoding
from polcap.formats.raw.probe import Probe

_ZOOM = 0.01  # relative change of the focal length above rounding
_HEADROOM = 1.05  # white of radiance over its greatest value: above `hdr.clip`, so that nothing is over-exposed
LOSS = ": normals and albedo lose accuracy against RAW"
_SHOOT_RAW = "; set the camera to RAW or DNG"


def read(folder: str | Path, angles_deg: tuple[float, ...] | None = None, clockwise: bool = False) -> Capture:
    """Read a capture folder: pol000/ pol045/ …, capture.toml, flat, or polarization-sensor frames.

    Every file's metadata and bytes are read, but no pixel is decoded. `angles_deg` is the order of the brackets of a
    flat folder (0, 45, 90 by default). In other layouts it selects from the angles that the folder states; the first is
    the reference. `clockwise`: the stated angles are counted clockwise in the picture.

    Raises CaptureError: the photographs do not form a capture; the message names the file, the reason and the remedy.
    Raises DecodeError: a file is cut short, or no decoder recognizes it.
    """
    folder = Path(folder)
    missing = unfinished.missing_frames(folder)
    try:
        found = _read(folder, angles_deg, clockwise)
    except CaptureError as error:
        if not missing:
            raise
        reason = str(error).partition("; ")[0]
        raise CaptureError(f"{reason}; {unfinished.advice(folder, missing)}") from None
    return found if not missing else replace(found, notes=(*found.notes, unfinished.advice(folder, missing)))


def _read(folder: Path, angles_deg: tuple[float, ...] | None, clockwise: bool) -> Capture:
    """As `read`. Raises CaptureError or DecodeError."""
    _check_folder(folder)
    stated = capture_toml.load(folder)
    clockwise = clockwise or stated.clockwise
    if angles_deg is not None:
        _check_angles(folder, angles_deg, "--angles states")
    plan = layouts.plan(folder, stated, angles_deg)
    _check_angles(folder, [angle for angle, _ in plan.shots], "the shots' angles are")
    if clockwise:
        if plan.layout == "sensor":
            raise CaptureError(
                f"{folder}: clockwise is stated, but a polarization sensor has no ring; leave it out, and state the "
                "angles of its 2×2 cell as `cells` in capture.toml"
            )
        plan = layouts.counted_clockwise(plan)

    sources = _photographs(folder, plan)
    _check_one_camera({path: source.probe.exif for path, source in sources.items()})
    _check_no_duplicate(sources)
    if plan.layout != "sensor":
        _check_encodings(sources, stated)
    greatest = max((source.probe.top for source in sources.values()), default=0.0)
    if greatest > 1 and not stated.white:  # floating point states no white level; one for all frames
        stated = msgspec.structs.replace(stated, white=float(f"{_HEADROOM * greatest:.4g}"))
    shots = tuple(_shot(plan, stated, angle, bracket) for angle, bracket in plan.shots)
    _check_brackets(shots)
    crossed = None if plan.layout == "sensor" else _crossed(folder, plan, stated)
    reference = shots[0].frames[0].exif
    calibration, calibration_notes = None, list[str]()
    if plan.layout != "sensor" and plan.shots[0][1][0].probe.kind == "raw":  # a polarizer on a ring, sensor counts
        calibration, calibration_notes = calibrations.choose(reference, stated.filter, stated.focal_length_mm)
    step = 2 if plan.layout == "sensor" else 1  # a plane of a sensor mosaic has half its sides
    size = (reference.width or 0) // step, (reference.height or 0) // step
    lens, principal = _lens(reference, stated, calibration, size)
    return Capture(
        name=atomic.safe_name(stated.name or Path(os.path.realpath(folder)).name),
        folder=str(folder),
        shots=shots,
        layout=plan.layout,
        focal_px=lens.px / step,
        focal_known=lens.known,
        focal_doubt=lens.doubt,
        principal_px=principal,
        size_px=size,
        chart_frames=tuple(
            _frame(plan, stated, source, plan.shots[0][0]) for source in plan.others if source.role == "chart"
        ),
        notes=(*plan.notes, *_notes(plan, shots, stated, greatest), *calibration_notes, f"focal length {lens.note}"),
        calibration=calibration,
        crossed=crossed,
        catalog=stated.catalog,
        angles=_statement(folder, plan, clockwise, calibration),
        lens_filter=stated.filter or "",
        accuracy=ball_accuracies.choose(reference, stated.filter),
    )


def _check_folder(folder: Path) -> None:
    """Raise CaptureError for a file, an archive or a missing folder."""
    if folder.is_file():
        if zipfile.is_zipfile(folder):
            raise CaptureError(f"{folder} is a ZIP archive; unpack it and give the folder that it holds")
        raise CaptureError(f"{folder} is a file; give the folder that holds all photographs of the object")
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give the folder that holds the photographs")


def _check_encodings(sources: dict[Path, Source], stated: CaptureFile) -> None:
    """Raise CaptureError for finished pictures of contradictory encodings, unless the user states the encoding."""
    if stated.encoding is not None:
        return
    first: dict[int, tuple[Path, str]] = {}  # of each number of bits
    for path, source in sources.items():
        found, bits = source.probe.encoding, source.probe.bits
        name = photo.encoding_of(bits, found)
        if found.fault:
            raise CaptureError(f"{path}: {found.fault}")
        if stated.white and found.curve not in ("", "linear"):
            raise CaptureError(
                f"{path}: its {found.source} states {found.curve}, but capture.toml states white, a level of linear "
                'pictures; state encoding = "linear" too, or remove white'
            )
        other, usual = first.setdefault(bits, (path, name))
        if name != usual:
            raise CaptureError(
                f"{path}: is {name}, but {other} is {usual}; save all pictures alike, or state encoding in capture.toml"
            )


def _statement(folder: Path, plan: layouts.Plan, clockwise: bool, calibration: Calibration | None) -> AngleStatement:
    """The statement of the angles, with the reason why they are counted clockwise, if they are."""
    ring = None if calibration is None else calibration.polarizer
    if ring is None or ring.sense > 0:
        return replace(plan.angles, clockwise="stated" if clockwise else "")
    if clockwise:
        raise CaptureError(f"{folder}: clockwise is stated, but the ring's calibration turns it already; leave it out")
    return replace(plan.angles, clockwise="calibrated")


def _lens(
    exif: Exif, stated: CaptureFile, calibration: Calibration | None, size: tuple[int, int]
) -> tuple[FocalLength, tuple[float, float]]:
    """Focal length and principal point [px]: calibrated at this picture size, else stated, from EXIF, or assumed."""
    geometry = None if calibration is None else calibration.geometry
    if geometry is not None and geometry.size_px == size:
        return focal_length.calibrated(geometry), geometry.principal_px
    lens = focal_length.find(exif, stated.focal_length_mm, stated.sensor_width_mm)
    return lens, ((size[0] - 1) / 2, (size[1] - 1) / 2)


def _photographs(folder: Path, plan: layouts.Plan) -> dict[Path, Source]:
    """All photographs of a plan; a file that the plan lists twice appears once."""
    listed = [source for _, bracket in plan.shots for source in bracket]
    if plan.layout == "sensor":  # a frame holds all angles
        listed = list({source.path: source for source in listed}.values())
    sources = {source.path: source for source in (*listed, *plan.others)}
    if len(sources) < len(listed) + len(plan.others):
        raise CaptureError(f"{folder / capture_toml.NAME}: names a file twice; give each frame one entry")
    return sources


def table(capture: Capture) -> str:
    """The capture as a text table: one line per photograph, then camera, lens, focal length and notes."""
    rows = [["angle", "file", "role", "exposure", "ISO", "f/", "flash", "taken"]]
    for shot in capture.shots:
        for frame in (*shot.frames, *shot.ambient):
            rows.append([shot.name, *_row(frame, capture.folder)])
    if capture.crossed is not None:
        rows += [[capture.crossed.name, *_row(frame, capture.folder)] for frame in capture.crossed.frames]
    rows += [["", *_row(frame, capture.folder)] for frame in capture.chart_frames]
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
    exif = capture.shots[0].frames[0].exif
    frames = " + ".join(str(len(shot.frames)) for shot in capture.shots)
    lines += [
        "",
        f"capture  {capture.name} ({capture.layout}): {len(capture.shots)} shots, {frames} frames",
        f"camera   {exif.camera or 'not stated'}, {capture.size_px[0]}×{capture.size_px[1]} px",
        f"lens     {exif.lens or 'not stated'}",
        f"focal    {capture.focal_px:.0f} px" + ("" if capture.focal_known else " (assumed)"),
    ]
    return "\n".join([*lines, *(f"note     {note}" for note in capture.notes)])


def _row(frame: Frame, folder: str) -> list[str]:
    """Row of the capture's table: file, role, exposure, ISO, f-number, flash, time."""
    exif = frame.exif
    path = Path(frame.path)
    name = str(path.relative_to(folder)) if path.is_relative_to(folder) else frame.path
    flash = {True: "fired", False: "off", None: "?"}[exif.flash_fired]
    stated = f"{frame.exposure:.4g} (stated)" if frame.exposure else layouts.shutter(exif.exposure_time)
    numbers = [f"{value:g}" if value else "?" for value in (exif.iso, exif.f_number)]
    return [name, frame.role, stated, *numbers, flash, exif.taken.replace("T", " ") or "?"]


def _shot(plan: layouts.Plan, stated: CaptureFile, angle_deg: float, bracket: Sequence[Source]) -> Shot:
    """A shot of the plan, with its bracket and the ambient frames of its angle; without these, with those of all."""
    of_all = [source for source in plan.others if source.role == "ambient"]
    ambient = [source for source in of_all if source.angle_deg in (None, angle_deg)] or of_all
    cell = _cell(plan, angle_deg)
    return Shot(
        angle=math.radians(angle_deg),
        frames=_sorted_alike(_frame(plan, stated, source, angle_deg) for source in bracket),
        ambient=_sorted_alike(_frame(plan, stated, source, angle_deg) for source in ambient),
        place_px=(0.0, 0.0) if cell is None else (cell[1] / 2, cell[0] / 2),
    )


def _cell(plan: layouts.Plan, angle_deg: float) -> tuple[int, int] | None:
    """Row and column of an angle in a polarization sensor's 2×2 cell; None for other captures and photographs."""
    places = zip(plan.shots, plan.angles.cells)
    return next((cell for (angle, _), cell in places if angle == angle_deg), None)


def _crossed(folder: Path, plan: layouts.Plan, stated: CaptureFile) -> Shot | None:
    """The cross-polarized shot (polarizer on the flash too), if any; by default its angle is that of the first shot."""
    sources = [source for source in plan.others if source.role == "cross"]
    if not sources:
        return None
    angles = {source.angle_deg for source in sources}
    if len(angles) > 1:
        listed = ", ".join("unstated" if angle is None else f"{angle:g}°" for angle in angles)
        raise CaptureError(f"{folder}: cross-polarized frames at {listed}; take them at one angle of the lens's filter")
    angle = angles.pop()
    return _shot(plan, stated, plan.shots[0][0] if angle is None else angle, sources)


def _frame(plan: layouts.Plan, stated: CaptureFile, source: Source, angle_deg: float) -> Frame:
    """A photograph of the plan, with the options for its decoding."""
    cell = _cell(plan, angle_deg)
    kind: Literal["raw", "photo"] = "raw" if source.probe.kind == "raw" else "photo"
    # the digest names how the file is read, because it enters the keys of the stage cache
    levels = [f"{stated.white:g}"] if stated.white else []
    levels += [f"-{stated.black:g}"] if stated.black else []
    if cell is not None:
        settings = [f"sensor {cell[0]},{cell[1]}", *levels]
    else:
        settings = [] if kind == "raw" else [*_encoding(source.probe, stated), *levels]
    return Frame(
        path=str(source.path),
        exif=source.probe.exif,
        role=source.role,
        digest=" ".join([source.probe.digest, *settings]),
        exposure=_stated_exposure(source),
        reading=FrameReading(kind, stated.encoding, stated.white, stated.black, cell),
    )


def _encoding(probe: Probe, stated: CaptureFile) -> list[str]:
    """Words for a finished picture's digest that state how it is decoded: its tone curve, and whether colors change.

    The curve is "default" where the number of bits alone decides. Colors in other primaries become Rec.709.
    """
    found = probe.encoding
    usual = photo.encoding_of(probe.bits, found) == photo.encoding_of(probe.bits, ColorEncoding())
    return [stated.encoding or ("default" if usual else found.curve), *["primaries"] * bool(found.to_rec709)]


def _stated_exposure(source: Source) -> float | None:
    """Relative exposure that capture.toml states, or that follows from a stated flash energy; None: not stated."""
    if source.flash_energy:
        exif = source.probe.exif
        return source.flash_energy * (exif.iso or 100.0) / 100.0 / (exif.f_number or 1.0) ** 2
    return source.exposure


def _exposure(frame: Frame) -> float | None:
    """Relative exposure of a photograph: stated, else by its EXIF; None: unknown."""
    return frame.exposure or frame.exif.relative_exposure


def _sorted_alike(frames: Iterable[Frame]) -> tuple[Frame, ...]:
    """Frames so that the same exposure has the same index in every shot: by stated exposures, else by names.

    The stage `hdr` measures from the pixels which frame is darkest, because cameras do not state a flash's power.
    """
    listed = sorted(frames, key=lambda frame: folder_names.natural(Path(frame.path).name))
    if not all(map(_exposure, listed)):
        return tuple(listed)
    return tuple(sorted(listed, key=lambda frame: _exposure(frame) or 0.0))


def _check_angles(folder: Path, angles_deg: Sequence[float], who: str) -> None:
    """Check the polarizer angles [°]; `who` begins the message. Raises SettingError or CaptureError."""
    if not all(isinstance(angle, Real) for angle in angles_deg):  # from Python
        raise SettingError(f"--angles = {angles_deg!r:.60}: it holds no numbers; give degrees, such as (0, 45, 90)")
    count = folder_names.count_axes(angles_deg)
    if count < 3:
        listed = ", ".join(f"{angle:g}" for angle in angles_deg) or "none"
        unread = ", ".join(folder_names.numbered(folder))
        remedy = "add the missing shot"
        if unread:
            remedy += f", or name {unread} as polcap reads it: pol000, pol045, …"
        found = "1 polarizer angle" if count == 1 else f"{count} different polarizer angles"
        raise CaptureError(f"{folder}: {who} {listed}: {found} where 3 are needed; {remedy}")


def other_equipment(exif: Exif, first: Exif) -> str | None:
    """Difference in camera, lens, size or focal length of one photograph from the first; None for equal equipment."""
    lengths = exif.focal_length_mm, first.focal_length_mm
    zoomed = lengths[0] and lengths[1] and abs(lengths[0] / lengths[1] - 1) > _ZOOM
    rows = (
        ("was taken with", exif.camera, first.camera),
        ("was taken through", exif.lens or first.lens, first.lens or exif.lens),
        ("has", f"{exif.width}×{exif.height} px", f"{first.width}×{first.height} px"),
        ("was taken at", f"{lengths[0]:g} mm" if zoomed else "", f"{lengths[1]:g} mm" if zoomed else ""),
    )
    return next((f"{text} {found}, not {wanted}" for text, found, wanted in rows if found != wanted), None)


def _check_one_camera(exifs: dict[Path, Exif]) -> None:
    """Raise CaptureError for photographs of different equipment."""
    first_path, first = next(iter(exifs.items()))
    for path, exif in exifs.items():
        if fault := other_equipment(exif, first):
            raise CaptureError(f"{path}: {fault} as {first_path.name}; use one set-up per capture, or remove the file")


def _check_no_duplicate(sources: dict[Path, Source]) -> None:
    """Raise CaptureError for a photograph that occurs twice, also as a DNG converted from it."""
    first: dict[str, Path] = {}
    pairs = [(source.path, first.setdefault(source.probe.digest, path)) for path, source in sources.items()]
    pairs += [(dng.path, raw.path) for dng, raw in layouts.conversions(list(sources.values()))]
    for path, other in pairs:
        if path != other:
            raise CaptureError(f"{path}: is the same photograph as {other}; remove one, and shoot the missing one")


def _check_brackets(shots: Sequence[Shot]) -> None:
    """Raise CaptureError for brackets of unequal length or exposure, with the likely remedy."""
    counts = [len(shot.frames) for shot in shots]
    usual = max(set(counts), key=counts.count)
    model = next(shot for shot in shots if len(shot.frames) == usual)
    files = {shot.name: [_exposed(frame) for frame in shot.frames] for shot in shots}
    remedy = unequal_brackets.advise_shots(files) or "shoot equal brackets, or remove the surplus"
    for shot in shots:
        where = Path(shot.frames[0].path).parent
        if len(shot.frames) != usual:
            raise CaptureError(
                f"{where}: {shot.name} has {len(shot.frames)} frames where {model.name} has {usual}; {remedy}"
            )
        for frame, other in zip(shot.frames, model.frames):
            if not same_exposure(_exposure(frame), _exposure(other)):
                raise CaptureError(
                    f"{frame.path}: {_settings(frame)} where {model.name} has {_settings(other)} "
                    f"({Path(other.path).name}); shoot equal brackets at every angle"
                )


def _exposed(frame: Frame) -> unequal_brackets.ExposedFile:
    path = Path(frame.path)
    return layouts.exposed_file(f"{path.parent.name}/{path.name}", frame.exif, frame.exposure)


def _settings(frame: Frame) -> str:
    """Exposure of a photograph in words."""
    if frame.exposure:
        return f"exposure {frame.exposure:.4g} stated"
    exif = frame.exif
    parts = [layouts.shutter(exif.exposure_time), f"f/{exif.f_number or '?'}", f"ISO {exif.iso or '?'}"]
    return " ".join(parts) if exif.exposure_time else "no exposure in EXIF"


def _notes(plan: layouts.Plan, shots: Sequence[Shot], stated: CaptureFile, greatest: float) -> list[str]:
    """Notes on what was understood or ignored, for table and report."""
    sources = [source for _, bracket in plan.shots for source in bracket]
    notes, first = [], sources[0].probe
    cross = sum(source.role == "cross" for source in plan.others)
    if cross and plan.layout == "sensor":
        notes.append(f"not used: {cross} cross-polarized frames, which a polarization sensor cannot take")
    if first.kind == "photo":
        notes += _encoding_notes(first, stated, plan.layout == "sensor")
    if greatest > 1:
        notes.append(f"radiance up to {greatest:.4g}: over-exposed from white = {stated.white:g} on, see capture.toml")
    if count := len({source.path for source in sources if source.probe.gain_map}):
        notes.append(f"not applied: the gain maps of {count} files")
    if first.lossy:
        notes.append("lossy DNG" + LOSS)
    if stated.rotator:
        notes.append(f"rotator {stated.rotator.model or 'of unknown model'}, log {stated.rotator.log or 'none'}")
    exposures = [exposure for frame in shots[0].frames if (exposure := _exposure(frame))]
    if len(exposures) == len(shots[0].frames) > 1 and same_exposure(max(exposures), min(exposures)):
        notes.append("all frames of a bracket state the same exposure; their ratios are measured from the pixels")
    return notes


def _encoding_notes(first: Probe, stated: CaptureFile, sensor: bool) -> list[str]:
    """Notes on the encoding of finished pictures, and on a statement of their files that is not used."""
    found, notes = first.encoding, []
    name = "linear" if sensor else stated.encoding or photo.encoding_of(first.bits, found)
    as_stated = f", as their {found.source} states" * (name == found.curve)
    loss = (LOSS + _SHOOT_RAW) * (first.bits == 8)
    if not sensor:
        notes.append(f"finished pictures of {first.bits} bits, taken as {name}{as_stated}{loss}")
    if found.curve and name != found.curve:
        why = "a sensor's frames are linear" if sensor else "capture.toml decides"
        notes.append(f"not used: their {found.source} states {found.curve}, but {why}")
    return notes
