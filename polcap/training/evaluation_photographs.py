"""Evaluation on photographs with measured normals, `polcap evaluate --real`: errors of the estimated normals.

The folder has the layout of public shape-from-polarization data sets, which are not included.

    DIR/pol000/NAME.png  pol045  pol090  pol135   photographs behind a polarizer, or of a polarization sensor
    DIR/mask/NAME.png                             not 0 on the object
    DIR/normal/NAME.png                           n/2 + ½, camera frame, y up; 8 or 16 bit

At least three angles are needed. Photographs pass the whole path, with the mask of the folder and without a chart. Most
of these sets have light from all sides, not the flash that polcap needs.
"""

import tempfile
from pathlib import Path

import numpy as np

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats import atomic, own_files
from polcap.formats.capture import reader as captures
from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import frames
from polcap.pipeline import models
from polcap.pipeline.cache import MemoryCache
from polcap.pipeline.path import UserInput, path
from polcap.results import ResultsUntilInfer
from polcap.stage_values import Cues, Network
from polcap.training.progress import Report, silent
from polcap.training.scores import LIMITS_DEG, Score, grid, mean_score

_MISSED_DEG = 90.0  # error of a pixel of the object without an estimated normal
_MIN_DOLP, _MIN_TILT = 0.03, 0.3  # for the comparison of AoLP and azimuth; tilt: sine of the zenith


def main(folder: Path, model: Path, out: Path, report: Report = silent) -> dict[str, Score]:
    """Evaluate every photograph set with and without the network; writes real.json and real.md to `out`.

    Raises InputError: the folder does not have this layout. StorageError: `out` has such a file that polcap did not
    write.
    """
    names, angles = _list_pictures(folder)
    network = models.open_network(model)
    own_files.claim(out, ("real.json", "real.md"))
    rows = {}
    for k, name in enumerate(names, 1):
        rows[name] = {"ours": score(folder, angles, name, network), "analytic": score(folder, angles, name, None)}
        mean, analytic = (rows[name][column]["mean"] for column in ("ours", "analytic"))
        report(f"{k}/{len(names)}  {name}: normals {mean:.2f}°, by the analytic estimator {analytic:.2f}°")
    table = {column: mean_score([both[column] for both in rows.values()]) for column in ("ours", "analytic")}
    result = {"folder": str(folder), "model": network.digest, "table": table, "pictures": rows}
    with own_files.opened(out):
        atomic.write_json(out / "real.json", result)
        atomic.write(out / "real.md", _page(folder, rows, table))
    return table


def _list_pictures(folder: Path) -> tuple[list[str], list[str]]:
    """Names of the pictures with a normal map, and of the folders of angles; checks that no file is missing."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder that holds pol000, pol045, …, mask and normal")
    angles = sorted(place.name for place in folder.glob("pol[0-9]*") if place.is_dir())
    names = sorted(place.name for place in (folder / "normal").glob("*.png"))
    if len(angles) < 3 or not names:
        raise InputError(
            f"{folder} holds {len(angles)} folders pol… and {len(names)} normal maps; --real needs the folders pol000 "
            "pol045 pol090 [pol135], mask and normal, with pictures of the same names"
        )
    for file in (folder / part / name for name in names for part in (*angles, "mask")):
        if not file.exists():
            raise InputError(f"{file} is missing; a normal map needs a mask and a picture per angle")
    return names, angles


def score(folder: Path, angles: list[str], name: str, network: Network | None) -> Score:
    """Process one object's photographs; returns normal errors against the measured normals [°], and shares 0…1."""
    picture, vector = png.read(folder / "mask" / name), png.read(folder / "normal" / name)
    mask = np.asarray(picture > 0 if picture.ndim == 2 else (picture[..., :3] > 0).any(axis=-1))
    truth = frames.unit(vector[..., :3].astype(np.float64) / np.iinfo(vector.dtype).max * 2 - 1)
    with tempfile.TemporaryDirectory() as place:
        for angle in angles:
            (Path(place) / "shots" / angle).mkdir(parents=True)
            (Path(place) / "shots" / angle / name).symlink_to((folder / angle / name).resolve())
        capture = captures.read(Path(place) / "shots", None)
        supplied = UserInput(chart=ChartRequest("none"), mask=mask, network=network)
        found = path(capture, supplied, Config(), MemoryCache(), ResultsUntilInfer)
    maps, (x0, y0, x1, y1) = found.maps, found.object_.crop
    by = round(mask.shape[0] / found.radiance.value.shape[1])
    inside, crop = mask[::by, ::by], np.s_[y0:y1, x0:x1]
    there = truth[::by, ::by][crop]
    error = np.full(inside.shape, np.nan)
    error[crop] = np.where(maps.mask, frames.angle_deg(maps.normal, there), np.nan)
    covered = float(np.isfinite(error[inside]).mean())
    error = np.nan_to_num(error[inside], nan=_MISSED_DEG)
    figures = {"mean": float(error.mean()), "median": float(np.median(error))}
    figures |= {f"within {limit:g}°": float((error < limit).mean()) for limit in LIMITS_DEG}
    return figures | {"covered": covered, "diffuse direction": diffuse_direction(found.cues, there)}


def diffuse_direction(cues: Cues, normal: Floats) -> float:
    """Mean cos 2(AoLP − azimuth of `normal`) where DoLP and tilt suffice: 1 for diffuse, −1 for specular reflection."""
    use = cues.mask & (cues.dolp > _MIN_DOLP) & (np.hypot(normal[..., 0], normal[..., 1]) > _MIN_TILT)
    turned = 2 * np.arctan2(normal[..., 1], normal[..., 0])[use]
    cos, sin = cues.normalized_stokes[:, use]
    return float((cos * np.cos(turned) + sin * np.sin(turned)).mean()) if use.any() else 0.0


def _page(folder: Path, rows: dict[str, dict[str, Score]], table: dict[str, Score]) -> str:
    named = [(f"mean, {column}", figures) for column, figures in table.items()]
    named += [(f"{name}, {column}", figures) for name, both in rows.items() for column, figures in both.items()]
    body = [[name, *(f"{value:.3g}" for value in figures.values())] for name, figures in named]
    return (
        f"# Photographs with measured normals: {folder.name}\n\n{grid(['', *table['ours']], body)}\n\n"
        f"Degrees, over the mask of the folder; a pixel without a normal counts as {_MISSED_DEG:g}°.\n\n"
        "`diffuse direction`: mean cos 2(AoLP − azimuth of the measured normals). It is 1 for diffuse reflection, as "
        "under a flash next to the lens. Below 0 most light is mirrored from the surroundings; polcap's inversion does "
        "not model it.\n"
    )
