"""Benchmark of fine relief: normal error by band of detail, with and without the refinement network.

Pictures of the evaluation at 1,024².

    python -m tests.benchmarks.bench_detail DATA [--pictures 6] [--size 1024] [--protocol 1] [--store DIR] [--look PNG]

The objects are test meshes in test materials, engraved with lettering, a relief that training never draws. The error of
the normals is split into three bands of wavelength: below two pixels of the first network, from there to the detail
that the inversion adds, and above. Each figure is the rms difference of the band-passed normals inside the eroded
mask, in degrees. The first band is split again: at edges where one part hides another, and elsewhere. Squares add up.
--store keeps the pictures for another run, --look writes a part of each picture: light, before, after, truth.
"""

import json
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from polcap.formats import onnx
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.stage_values import Network
from polcap.stages import infer
from polcap.training.evaluation_protocol import Case, Protocol
from tests.experiments import arguments, networks

_HALF = 0.375  # σ of the Gaussian that halves a wave of two, in units of half its length: √(2 ln 2)/π
_TEXELS, _PERIOD = 1024, 0.6  # of the lettering; its length in sides of the object
_DEEP = 0.7  # its steepest slope
_JUMP, _BESIDE = 0.06, 3  # depth step of an edge [radii of the object]; px on either side of it
_COARSE = 2.0  # px of the first network, 1σ: finer detail comes from the refinement and the inversion


def main() -> None:
    options = arguments(__doc__, "data", pictures=6, size=1024, protocol=1, store=Path, look=Path)
    network = networks("network")[0]
    rows: list[dict[str, dict[str, float]]] = []
    looks: list[Floats] = []
    for case in _cases(options.data, options.size, options.protocol, options.pictures, options.store):
        before = infer.estimate(case.cues, network, onnx.run, infer.InferSettings(fine=False))
        after = infer.estimate(case.cues, network, onnx.run, infer.InferSettings())
        both = {"before": errors(before.normal, case, network), "after": errors(after.normal, case, network)}
        rows.append(both)
        print(json.dumps({"picture": case.name, **both}), flush=True)
        if options.look:
            looks.append(_look(case, before.normal, after.normal))
    for band in rows[0]["before"]:
        was, now = (float(np.mean([row[when][band] for row in rows])) for when in ("before", "after"))
        print(f"{band:>16}  {was:6.2f}°  {now:6.2f}°  {100 * (now / was - 1):+.1f} %")
    if options.look:
        cv2.imwrite(str(options.look), np.concatenate(looks))


def errors(normal: Floats, case: Case, network: Network | None) -> dict[str, float]:
    """Mean angle, and rms by bands, degrees."""
    native = 256 if network is None else int(network.metadata["native_size"])
    shrink = max(1.0, max(case.cues.mask.shape) / native)
    truth, inside = case.truth.normal, case.truth.mask & case.cues.mask
    solid = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    off = (normal - truth) * inside[..., None]
    fine, middle = off - _smooth(off, inside, _HALF * shrink), off - _smooth(off, inside, _COARSE * shrink)
    angle = frames.angle_deg(normal, truth)[solid]

    def rms(image: Floats) -> float:
        return float(np.degrees(np.sqrt((image[solid] ** 2).sum(-1).mean())))

    edge = _edges(case.depth, inside)[..., None]
    return {
        "mean": float(angle.mean()), "median": float(np.median(angle)), "beyond Nyquist": rms(fine),
        "of it at edges": rms(fine * edge), "elsewhere": rms(fine * ~edge), "to 2 px": rms(middle - fine),
        "coarser": rms(off - middle),
    }  # fmt: skip


def _edges(depth: Floats, inside: Bools) -> Bools:
    """Pixels (H, W) next to those of one part of the object that hides another."""
    small, large = np.ones((3, 3), np.uint8), np.ones((2 * _BESIDE + 1, 2 * _BESIDE + 1), np.uint8)
    low, high = (np.where(inside, depth, beyond).astype(np.float32) for beyond in (1e3, -1e3))
    jump = (cv2.dilate(high, small) - cv2.erode(low, small) > _JUMP) & inside
    return np.asarray(cv2.dilate(jump.astype(np.uint8), large) > 0)


def _smooth(image: Floats, inside: Bools, sigma: float) -> Floats:
    share = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), sigma)
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma) / np.maximum(share, 1e-3)[..., None])


class Lettering:
    """Words cut into the three coordinate planes of an object of longest side 1."""

    def __init__(self) -> None:
        drawn = np.zeros((_TEXELS, _TEXELS), np.uint8)
        for row, word in enumerate(("polarize", "0 45 90", "Stokes", "relief", "ABC xyz")):
            at = (12 + 9 * row, int((row + 0.75) * _TEXELS / 5))
            cv2.putText(drawn, word, at, cv2.FONT_HERSHEY_DUPLEX, 3.2, 255, 6, cv2.LINE_AA)
        height = cv2.GaussianBlur(drawn.astype(np.float32), (0, 0), 2.0)
        slope = np.stack([np.gradient(height, axis=1), np.gradient(height, axis=0)], axis=-1)
        self.slope = (_DEEP * slope / np.abs(slope).max()).astype(np.float32)

    def __call__(self, place: Floats, facing: Floats) -> Floats:
        """Gradient (M, 3) of the relief at places (M, 3) that face (M, 3)."""
        axis = np.abs(facing).argmax(axis=1)
        rows = np.arange(len(place))
        along = np.stack([(axis + 1) % 3, (axis + 2) % 3], axis=1)
        texel = np.floor(np.mod(np.stack([place[rows, k] for k in along.T], axis=1) / _PERIOD, 1) * _TEXELS).astype(int)
        out = np.zeros(place.shape, np.float32)
        for k in (0, 1):
            out[rows, along[:, k]] = self.slope[texel[:, 1], texel[:, 0], k]
        return out


def _cases(data: Path, size: int, protocol: int, count: int, store: Path | None) -> Iterator[Case]:
    made = None
    for number in range(count):
        path = None if store is None else store / f"lettered_{protocol}_{size}_{number}.pkl"
        if path is not None and path.exists():
            yield pickle.loads(path.read_bytes())
            continue
        if made is None:
            made = Protocol(data, size, protocol)
            made.materials = [replace(one, slope=Lettering()) for one in made.materials]
        case = made.case(number)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(case))
        yield case


def _look(case: Case, *normals: Floats) -> Floats:
    """The busiest part of a picture: its light, the normals, the truth."""
    side = 320
    inside = case.truth.mask.astype(np.float32)
    relief = np.abs(case.truth.normal - _smooth(case.truth.normal, case.truth.mask, 6.0)).sum(-1) * inside
    around = cv2.blur(relief, (side, side))[side // 2 : -side // 2, side // 2 : -side // 2]
    y, x = np.unravel_index(int(around.argmax()), around.shape)
    light = np.clip(case.cues.radiance, 0, 1) ** 0.45
    shown = [light, *((n + 1) / 2 * case.cues.mask[..., None] for n in (*normals, case.truth.normal))]
    return np.concatenate([(255 * part[y : y + side, x : x + side, ::-1]).astype(np.uint8) for part in shown], axis=1)


if __name__ == "__main__":
    main()
