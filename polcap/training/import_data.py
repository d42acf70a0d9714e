"""Converts meshes and texture folders of other people into the data folder of `polcap train`.

    python -m polcap.training.import_data SOURCE DATA

SOURCE is searched with all its sub-folders. Meshes are OBJ, GLB, glTF, PLY, STL or OFF files. A texture folder has a
picture of albedo and one of roughness; their names contain those words, as in `Bricks_2K_BaseColor.png`. Every tenth
mesh and texture folder, the first included, is for tests; a single one is for both. Needs the extra [train].
"""

import argparse
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from polcap.errors import DecodeError, InputError, PolcapError, StorageError
from polcap.formats import atomic, own_files, scene_files
from polcap.formats.capture import folder_names, foreign_files
from polcap.training.progress import Report, silent

_MESHES = {".obj", ".glb", ".gltf", ".ply", ".stl", ".off"}
_PICTURES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr"}
_ROLES = {  # of a texture by its file's name, the first that fits
    "roughness": re.compile(r"rough", re.IGNORECASE),
    "normal": re.compile(r"normal|(?<![a-z])nor(?![a-z])|(?<![a-z])nrm", re.IGNORECASE),
    "height": re.compile(r"height|displace|(?<![a-z])disp", re.IGNORECASE),
    "albedo": re.compile(r"albedo|base_?color|diff|(?<![a-z])colou?r|(?<![a-z])col(?![a-z])", re.IGNORECASE),
}
_GREEN_DOWN = re.compile(r"(?<![a-z])dx(?![a-z])|directx|(?<=normal)dx", re.IGNORECASE)
_TEST_EVERY = 10
_SIDE = 1024  # px, largest side of a texture; training uses 256


def main(source: Path, data: Path, report: Report = silent) -> tuple[int, int]:
    """Convert all meshes and texture folders below `source`; returns their numbers. Unusable ones are reported.

    Raises InputError: nothing usable was found. StorageError: a file in the place of one is not of this program.
    """
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; give the one that holds your meshes and textures")
    files = list(foreign_files.files_below(source))
    meshes = sorted(path for path in files if path.suffix.lower() in _MESHES and path.is_file())
    textures = _texture_folders(files, report)
    with own_files.claimed(data, ()):
        counts = (
            _convert(source, meshes, write_mesh, data / "meshes", ".npz", report),
            _convert(source, textures, write_textures, data / "materials", "", report),
        )
    if not any(counts):
        kinds = ", ".join(sorted(_MESHES))
        raise InputError(f"{source}: holds no mesh ({kinds}) and no folder with pictures of albedo and roughness")
    for noun, count in zip(("mesh", "texture folder"), counts):
        if count == 1:
            report(f"the only {noun} is for training and for tests: errors on it are too small; add others")
    report(f"{counts[0]} meshes and {counts[1]} texture folders in {data}")
    return counts


def _convert(
    source: Path, found: list[Path], write: Callable[[Path, Path], None], place: Path, suffix: str, report: Report
) -> int:
    """Write each mesh or texture folder into place/train, place/test or both; returns how many are usable."""
    count = 0
    for number, path in enumerate(found):
        try:
            for split in _splits(number, len(found)):
                write(path, place / split / f"{_name(path.relative_to(source))}{suffix}")
            count += 1
        except DecodeError as error:
            report(f"left out: {error}")
    return count


def _texture_folders(files: Iterable[Path], report: Report) -> list[Path]:
    """The folders with a picture of albedo and one of roughness; a folder with only one of them is reported."""
    complete = []
    for folder in sorted({path.parent for path in files if path.suffix.lower() in _PICTURES}):
        missing = sorted({"albedo", "roughness"} - _pictures(folder).keys())
        if not missing:
            complete.append(folder)
        elif len(missing) == 1:
            report(f"left out: {folder} has no picture with {missing[0]} in its name; rename or add it")
    return complete


def _splits(number: int, count: int) -> tuple[str, ...]:
    """The parts of the data folder, train or test, that get mesh or texture folder `number` of `count`."""
    if count == 1:
        return ("train", "test")
    return ("test",) if number % _TEST_EVERY == 0 else ("train",)


def _name(path: Path) -> str:
    """Name of a mesh or texture folder, from its path inside the source."""
    return re.sub(r"[^A-Za-z0-9]+", "_", "_".join(path.with_suffix("").parts)).strip("_").lower() or "unnamed"


def write_mesh(path: Path, target: Path) -> None:
    """Write a mesh with vertices of 16 bits; equal vertices become one, so that seams of textures are smooth.

    Raises DecodeError: the file is no usable mesh.
    """
    vertices, faces = scene_files.read_mesh(path)
    low, size = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    if not size > 0:
        raise DecodeError(f"{path}: all its vertices are one point; give another mesh")
    quantized = np.rint((vertices - low) / size * 65535).astype(np.uint16)
    corners, place = np.unique(quantized, axis=0, return_inverse=True)
    joined = place.reshape(-1)[faces]
    distinct = (joined != np.roll(joined, 1, axis=1)).all(axis=1)  # three corners at different places
    with atomic.path(target) as temporary:
        np.savez_compressed(
            temporary, vq=corners, vmin=low, vscale=np.float32(size), faces=joined[distinct].astype(np.int32)
        )


def write_textures(folder: Path, target: Path) -> None:
    """Write the pictures of a texture folder as albedo.jpg, roughness.jpg and normal.jpg or height.jpg.

    Normal maps are turned to green down (DirectX) unless their name states it. Raises DecodeError.
    """
    for role, path in _pictures(folder).items():
        picture = _read(path)
        if role == "normal" and not _GREEN_DOWN.search(path.stem):
            picture = picture.copy()
            picture[..., 1] = 255 - picture[..., 1]
        with atomic.path(target / f"{role}.jpg") as temporary:
            if not cv2.imwrite(str(temporary), picture, [cv2.IMWRITE_JPEG_QUALITY, 95]):
                raise StorageError(f"{target / role}.jpg cannot be written; check the disk")


def _pictures(folder: Path) -> dict[str, Path]:
    """The pictures of a texture folder by role."""
    found: dict[str, Path] = {}
    for path in folder_names.children(folder):
        if path.suffix.lower() in _PICTURES and path.is_file():
            role = next((role for role, words in _ROLES.items() if words.search(path.stem)), None)
            if role is not None:
                found.setdefault(role, path)
    return found


def _read(path: Path) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]":
    """A picture (H, W, 3) of 8 bits, at most 1024 px wide and high, in OpenCV's order of the channels."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise DecodeError(f"{path}: is no picture that OpenCV reads; convert it to PNG")
    factor = min(1.0, _SIDE / max(picture.shape[:2]))
    return np.asarray(cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        prog="python -m polcap.training.import_data", description="Converts meshes and textures for polcap train."
    )
    parser.add_argument("source", type=Path, help="folder with meshes and texture folders")
    parser.add_argument("data", type=Path, help="data folder of polcap train")
    stated = parser.parse_args()
    try:
        main(stated.source, stated.data, lambda text: print(text, file=sys.stderr))
    except PolcapError as error:
        print(f"polcap: error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
