"""`polcap doctor FILE`: checks whether polcap can use a photograph: kind, metadata, mosaic pattern and levels."""

from collections.abc import Iterator
from pathlib import Path

from polcap.capture_values import Exif
from polcap.doctor import Finding
from polcap.errors import DecodeError
from polcap.formats.capture import focal_length
from polcap.formats.raw import libraw, photo, probe
from polcap.image_values import SensorImage
from polcap.optics import sensor
from polcap.stages import hdr

_MOST_COUNT = 1.1  # greatest count over the stated white level; files of a Nikon D5000 reach 1.07
_CLIP = hdr.HdrSettings().clip  # the default: `doctor` takes no settings


def examine_file(path: Path) -> Iterator[Finding]:
    """Check one photograph's kind, metadata, pixels and levels; yields the findings."""
    if path.is_dir():
        remedy = "give one photograph; `polcap process FOLDER --dry-run` lists a folder"
        yield Finding("file", "fault", f"{path} is a folder", remedy)
        return
    part = "file"
    try:
        found = probe.read(path)
        if found.kind not in ("raw", "photo"):
            message = f"{path.name} is not a photograph that polcap can read"
            yield Finding("file", "fault", message, "give a RAW, TIFF, PNG or EXR")
            return
        kind = "RAW" if found.kind == "raw" else f"finished picture of {found.bits} bits"
        size = f"{path.stat().st_size / 1e6:.1f} MB"
        yield Finding("file", "ok", f"{path.name}: {kind}, {size}, digest {found.digest[:12]}")
        yield from _metadata(found.exif)
        part = "pixels"
        image = libraw.read(path) if found.kind == "raw" else photo.read(path)
        yield from _pixels(image, found.exif)
    except DecodeError as error:
        message, _, remedy = str(error).partition("; ")  # its text is "fact", or "fact; remedy"
        yield Finding(part, "fault", message, remedy or "send this report in with the file")


def _metadata(exif: Exif) -> Iterator[Finding]:
    """Check camera, exposure and focal length in the EXIF of a photograph."""
    if exif.camera:
        message = f"{exif.camera}, {exif.lens or 'lens not stated'}, taken {exif.taken or 'at no stated time'}"
        yield Finding("camera", "ok", message)
    else:
        yield Finding("camera", "warning", "not stated", "copy the file without a program that strips EXIF")
    parts = {
        "exposure": exif.exposure_time and f"{exif.exposure_time:.4g} s",
        "f-number": exif.f_number and f"f/{exif.f_number:g}",
        "ISO": exif.iso and f"{exif.iso:g}",
        "flash": None if exif.flash_fired is None else "fired" if exif.flash_fired else "off",
    }
    missing = [name for name, value in parts.items() if not value]
    message = ", ".join(f"{name} {value}" for name, value in parts.items() if value) or "none"
    remedy = f"not stated: {', '.join(missing)}; exposures are then taken from the pixels" if missing else ""
    yield Finding("exposure", "warning" if missing else "ok", message, remedy)
    lens = focal_length.find(exif, None, None)
    remedy = "" if lens.known else "state focal_length_mm and sensor_width_mm in capture.toml"
    yield Finding("focal length", "ok" if lens.known else "warning", lens.note, remedy)


def _pixels(image: SensorImage, exif: Exif) -> Iterator[Finding]:
    """Check mosaic, size and levels of a decoded photograph."""
    height, width = image.value.shape[:2]
    size = f"{width}×{height} px"
    if image.cfa is not None:
        bayer = "".join("RGB"[color] for color in image.cfa.ravel())
        name = f"Bayer {bayer}" if image.superpixel == 2 else "X-Trans, merged as 3×3 superpixels"
        yield Finding("pattern", "ok", f"{name}, {size}")
    elif sensor.monochrome(image):
        remedy = "gains, normals and shape work; colors are gray, and no ColorChecker can be read"
        yield Finding("pattern", "warning", f"one channel (a monochrome sensor), {size}", remedy)
    else:
        yield Finding("pattern", "ok", f"three channels a pixel, {size}: developed or linear DNG, no mosaic left")
    missing = (exif.width or width) - width, (exif.height or height) - height
    if not all(0 <= side < image.superpixel for side in missing):  # a mosaic begins with a whole superpixel
        message = f"{size} decoded, but {exif.width}×{exif.height} are stated"
        yield Finding("size", "warning", message, "send this report in")
    black, white = float(image.black.mean()), image.white
    darkest, brightest = float(image.value.min()), float(image.value.max())
    clipped = sensor.clipped_share(image, _CLIP)
    message = f"black {black:g}, white {white:g}; counts {darkest:g} … {brightest:g}, {100 * clipped:.2f} % clipped"
    if brightest > _MOST_COUNT * white or white <= black:
        yield Finding("levels", "warning", message, "the white level does not fit the counts: send this report in")
    elif clipped > 0.5 or brightest <= black:
        yield Finding("levels", "warning", message, "nothing can be measured: change the exposure")
    else:
        yield Finding("levels", "ok", message)
    if image.camera_matrix is None:
        yield Finding("color matrix", "warning", "not known", "use a chart")
    else:
        yield Finding("color matrix", "ok", "known")
    if image.lossy:
        yield Finding("encoding", "warning", "8 bits or display-encoded", "shoot RAW: normals and albedo lose accuracy")
