"""Benchmark of the registration.

Errors for frames of a bracket under photon noise and for shots of rendered captures.

python -m tests.benchmarks.bench_registration          with $POLCAP_DATA for the rendered captures
"""

import json
import os
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from polcap.config import Config
from polcap.formats.capture import reader
from polcap.formats.raw.frame_decoder import decode
from polcap.image_values import Floats
from polcap.optics.projection import transform_points
from polcap.optics.registration import Pyramid, register, scaled
from polcap.stages import align, hdr
from tests.experiments import data

SIZE = (480, 600)
MOTIONS = [  # reference px → px of the other frame
    np.eye(3),
    np.array([[1, 0, 0.3], [0, 1, -0.2], [0, 0, 1.0]]),
    np.array([[1, 0, 6.4], [0, 1, -3.7], [0, 0, 1.0]]),
    np.array([[0.99998, -0.006, 4], [0.006, 0.99998, 1], [0, 0, 1.0]]),
    np.array([[1.002, 0.001, 2], [-0.001, 1.001, -4], [3e-6, -2e-6, 1]]),
]


def main() -> None:
    print("frames of one bracket, the other at a quarter of the light: rms and largest error, px")
    for electrons in (4000, 400, 100):
        errors = [_bracket_error(motion, electrons, seed) for motion in MOTIONS for seed in range(4)]
        print(f"{electrons:5d} e⁻ {np.sqrt(np.mean(np.square(errors))):.4f} {max(errors):.4f}")
    if "POLCAP_DATA" not in os.environ:
        return
    print("shots of the rendered captures: error of the second and the third, px of the merged picture")
    for file in sorted((data() / "rendered").glob("*.truth.json")):
        print(f"{file.name.split('.')[0]:16s}", *(f"{error:.4f}" for error in _capture_errors(file)))


def _bracket_error(motion: Floats, electrons: float, seed: int) -> float:
    random = np.random.default_rng(seed)
    frames = [
        random.poisson(electrons * share * _scene(matrix)) / (electrons * share)
        for matrix, share in ((np.eye(3), 1.0), (motion, 0.25))
    ]
    smooth = [cv2.GaussianBlur(frame.astype(np.float32), (7, 7), 0.8) for frame in frames]
    still, other = (Pyramid(np.sqrt(np.maximum(frame, 0) + 1e-4), np.ones(SIZE, bool)) for frame in smooth)
    return _rms(register(still, other).matrix, motion, SIZE)


@cache
def _texture() -> Floats:
    """Detail of many sizes, none finer than a sensor behind a lens shows, as spline coefficients."""
    random = np.random.default_rng(99)
    fields = [ndimage.gaussian_filter(random.normal(size=(800, 900)), sigma) for sigma in (1.5, 4, 12, 40)]
    return np.asarray(ndimage.spline_filter(np.sum([0.15 * field / field.std() for field in fields], axis=0)))


def _scene(motion: Floats) -> Floats:
    """Light (H, W)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    at = transform_points(np.linalg.inv(motion), np.stack([x, y], axis=-1)) + np.array([150, 160])
    return np.asarray(np.exp(ndimage.map_coordinates(_texture(), [at[..., 1], at[..., 0]], prefilter=False)))


def _capture_errors(file: Path) -> list[float]:
    capture = reader.read(file.with_name(file.name.removesuffix(".truth.json")), None)
    radiance = hdr.merge(capture, decode, Config().hdr)
    found = align.register(radiance, Config().align)
    frames = json.loads(file.read_text())["shots"]
    first = [frames[k * len(frames) // len(radiance.angle)] for k in range(1, len(radiance.angle))]
    true = [scaled(np.vstack([frame["affine_ref_to_shot"], [0, 0, 1]]), 1 / radiance.view.scale) for frame in first]
    return [_rms(a, b, radiance.value.shape[1:3]) for a, b in zip(found.transform[1:], true, strict=True)]


def _rms(a: Floats, b: Floats, size: tuple[int, ...]) -> float:
    """Root of the mean squared distance of two motions over a grid of points, px."""
    x, y = np.meshgrid(np.linspace(20, size[1] - 20, 9), np.linspace(20, size[0] - 20, 9))
    point = np.stack([x, y], axis=-1)
    return float(np.sqrt(np.mean(np.sum((transform_points(a, point) - transform_points(b, point)) ** 2, axis=-1))))


if __name__ == "__main__":
    main()
