"""Albedo at the RAW's pixels: printed detail finer than a superpixel comes back, shading of relief and noise do not."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from polcap.formats import onnx
from polcap.image_values import Distortion, Floats, Mosaic
from polcap.optics import color, demosaic, distortion, mueller, shade
from polcap.optics.resize import block_means
from polcap.stage_values import ObjectMask, StokesImage, SurfaceMaps
from polcap.stages import asset, cues, infer, stokes, surface
from polcap.stages.stokes.reference_detail import reference_detail
from tests import scenes

RGGB = np.array([[0, 1], [1, 2]], np.uint8)
GREY = 0.4
Y, X = np.mgrid[: 2 * scenes.HEIGHT, : 2 * scenes.WIDTH].astype(float)  # RAW px


def waves(seed: int, *periods: float) -> Floats:
    """Sum of waves of rms 1 in random directions, of periods in RAW px."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(X)
    for period in periods:
        turn, phase = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        total += np.sin(2 * np.pi / period * (np.cos(turn) * X + np.sin(turn) * Y) + phase)
    return np.asarray(total / np.sqrt(len(periods) / 2))


@dataclass(frozen=True)
class Photographed:
    """A ball of known albedo, the maps that polcap makes of it, and its asset."""

    albedo: Floats  # (2H, 2W) gray
    stokes: StokesImage
    maps: SurfaceMaps

    @property
    def inside(self) -> Floats:
        """Pixels (2H, 2W) where the ball turns away by less than 60°, without its outline."""
        place = (np.array([X, Y]) - 0.5) / 2 - np.array(scenes.CENTER)[:, None, None]
        return np.asarray(np.hypot(*place) < 0.85 * scenes.RADIUS)

    def base_color(self, raw_pixels: bool) -> Floats:
        """Green of the asset's base color, linear, on RAW pixels."""
        mesh = surface.integrate(self.maps, None, surface.SurfaceSettings())
        built = asset.build(self.maps, mesh, asset.AssetSettings(raw_pixels=raw_pixels))
        return cv2.resize(np.asarray(color.decode_srgb(built.base_color / 255), np.float32)[..., 1], X.shape[::-1])


def photograph(albedo: Floats, slope: Floats | float = 0.0, noise: float = 1e-3) -> Photographed:
    """Photograph and process a ball; `slope` tilts its normals along x, `noise` is 1σ of a photosite."""
    normal, inside = scenes.normals((X - 0.5) / 2, (Y - 0.5) / 2)
    normal[..., 0] += slope
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light, ones = np.zeros_like(normal), np.ones_like(X)
    light[..., 2] = 1
    rgb = np.repeat(albedo[..., None], 3, axis=-1)
    parts = shade.stokes(normal, rgb, 0.04 * np.ones_like(rgb), 0.5 * ones, 1.5 * ones, light, ones)
    rng = np.random.default_rng(1)
    shots = np.einsum("kj,jhwc->khwc", mueller.analyzer(scenes.ANGLES), np.where(inside[..., None], parts, 0.004))
    mosaics = np.empty((3, *X.shape), np.float32)
    for i, j in np.ndindex(2, 2):
        mosaics[:, i::2, j::2] = shots[:, i::2, j::2, RGGB[i, j]]
    mosaics += rng.normal(0, noise, mosaics.shape)
    value = np.stack([np.moveaxis(demosaic.superpixel(mosaic, RGGB), 0, -1) for mosaic in mosaics])
    radiance = replace(
        scenes.stack(),
        value=value,
        variance=np.broadcast_to(np.float32(noise**2 * np.array([1, 0.5, 1])), value.shape),
        mosaic=Mosaic(mosaics[0].astype(np.float16), RGGB),
    )
    ball = ObjectMask(inside[::2, ::2], (0, 0, scenes.WIDTH, scenes.HEIGHT), "user")
    seen = stokes.solve(radiance, scenes.still(3), scenes.equal(), ball, stokes.StokesSettings())
    maps = infer.estimate(cues.compute(seen, scenes.no_color()), None, onnx.run, infer.InferSettings())
    return Photographed(albedo, seen, maps)


def fine(image: Floats) -> Floats:
    """The part of an image that is finer than about three pixels."""
    return np.asarray(image - ndimage.gaussian_filter(image, 1.0))


def test_print_finer_than_a_superpixel_comes_back() -> None:
    """Periods of three to four RAW pixels, which the superpixels of two do not resolve."""
    ball = photograph(GREY * (1 + 0.15 * waves(2, 3.0, 3.3, 3.6, 4.0)))
    truth = fine(np.log(ball.albedo))[ball.inside]
    correlation, share = {}, {}
    for raw_pixels in (False, True):
        found = fine(np.log(np.maximum(ball.base_color(raw_pixels), 1e-3)))[ball.inside]
        correlation[raw_pixels] = np.corrcoef(found, truth)[0, 1]
        share[raw_pixels] = found @ truth / (truth @ truth)
    assert correlation[True] > 0.9 and share[True] > 0.6
    assert share[False] < 0.2


@pytest.mark.parametrize(
    ("slope", "noise"), [(0.1 * waves(3, 3.0, 4.0, 6.0, 9.0, 14.0, 20.0), 1e-3), (0.0, 1e-3), (0.0, 1e-2)]
)
def test_neither_shading_of_fine_relief_nor_noise_enters_the_albedo(slope: Floats | float, noise: float) -> None:
    """Relief of all scales down to that of the print, as it is seen in highlight, in facing and in slanted parts."""
    ball = photograph(np.full_like(X, GREY), slope, noise)
    assert ball.stokes.detail is not None and ball.maps.detail is not None
    photographed, ours = (part[ball.inside].astype(float).std() for part in (ball.stokes.detail, ball.maps.detail))
    assert ours < 0.3 * photographed


def test_dark_print_on_a_saturated_color_gets_no_dots() -> None:
    """Demosaiced colors may be negative there; their logarithm would be a pattern of black dots."""
    shape = ndimage.gaussian_filter((waves(5, 14.0, 18.0, 23.0) > 0.7).astype(float), 0.5)
    rgb = np.array([0.35, 0.08, 0.03]) + shape[..., None] * np.array([-0.33, -0.075, -0.024])
    mosaic = np.empty(X.shape, np.float16)
    for i, j in np.ndindex(2, 2):
        mosaic[i::2, j::2] = rgb[i::2, j::2, RGGB[i, j]]
    light = rgb.sum(axis=-1)
    coarse = cv2.resize(block_means(light, 2), X.shape[::-1])
    found = reference_detail(Mosaic(mosaic, RGGB), (0, 0, scenes.WIDTH, scenes.HEIGHT))
    error = np.abs(found - np.log(light / coarse))[8:-8, 8:-8]
    assert error.max() < 1.5 and np.sqrt(np.mean(error**2)) < 0.3


def test_detail_of_a_distorted_lens_is_where_the_pinhole_camera_sees_it() -> None:
    lens = Distortion(scenes.FOCAL, scenes.VIEW.center, 0.3, 0.0)

    def light(x: Floats, y: Floats) -> Floats:
        return np.asarray(0.5 + 0.1 * np.sin(1.3 * x + 0.4 * y))

    size = (scenes.WIDTH, scenes.HEIGHT)
    box = distortion.pinhole_box(lens, (80, 60, 240, 180), size)
    u, v = distortion.undistort(lens, (X - 0.5) / 2, (Y - 0.5) / 2)
    bent = reference_detail(Mosaic(light(2 * u, 2 * v).astype(np.float16), RGGB), box, lens)
    straight = reference_detail(Mosaic(light(X - 0.5, Y - 0.5).astype(np.float16), RGGB), box)
    assert straight.std() > 0.02
    assert np.abs(bent - straight).std() < 0.15 * straight.std()
