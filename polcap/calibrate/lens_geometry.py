"""Focal length and distortion of a lens, from photographs of a tilted checkerboard or ColorChecker.

A flat board at several tilts determines the camera (Zhang); OpenCV's bundle adjustment solves for it. OpenCV finds the
corners of a checkerboard; on a ColorChecker the centers of the patches are used, because blur does not move them.

References
----------
Zhang, A flexible new technique for camera calibration, IEEE TPAMI 2000; Brown, Photogrammetric Engineering 1971.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.calibrate.calibration_photographs import Photograph
from polcap.calibration_values import LensGeometry
from polcap.chart_values import ChartRequest
from polcap.errors import CaptureError, ChartError
from polcap.formats import shipped_data
from polcap.image_values import Distortion, Floats, SensorImage, View
from polcap.optics import distortion, sensor
from polcap.optics.projection import from_grid, transform_points
from polcap.stage_values import AngleStack, ColorSensor, single_frames
from polcap.stages import whitebalance
from polcap.stages.whitebalance import WhitebalanceSettings, chart

_LEAST_BOARDS = 6  # three tilts determine a pinhole camera; more show the error
_MOST_FOCAL_SIGMA = 0.01  # relative; with more, EXIF is better
_MOST_RESIDUAL = 1.5  # RAW px rms; a flat, sharp board has a tenth of it
_MOST_PRINCIPAL_SIGMA = 0.004  # of the width; with more, the principal point is the picture's middle
_WINDOW, _MOST_WINDOW_PX = 0.3, 6  # half side of a corner's search window: share of a square; at most, px
_SAMPLES = 31  # across a patch and half of its gaps, to measure the center
_LEAST_CONTRAST = 2.0  # patch over card
_CARD = 0.06  # share of the window at each side that shows the card: a patch has 0.88 of the pitch
_ITERATIONS = 6  # the window moves to the center found
_NORMAL = 1.4  # focal length over the picture's width of a normal lens, as a first guess
_MODEL = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3


@dataclass(frozen=True)
class BoardView:
    """Points of a calibration board in one photograph: on the flat board, and in the picture."""

    flat: Floats  # (N, 3) float32 on the board, in squares or patches; z = 0
    seen: Floats  # (N, 2) float32 RAW px
    name: str


def measure(photographs: list[Photograph], squares: tuple[int, int]) -> LensGeometry:
    """Measure focal length, principal point, distortion k₁ and k₂ of a lens, with 1σ.

    `squares` are the inner corners of the checkerboard, across and down.

    Raises CaptureError if too few photographs show a board, all have one tilt, or the corners do not fit a flat board.
    """
    folder = photographs[0].path.parent
    boards: list[BoardView] = []
    size: tuple[int, int] | None = None
    for one in photographs:
        image = one.image()
        shape = image.value.shape[1], image.value.shape[0]
        size = size or shape
        if shape != size:
            raise CaptureError(f"{one.path}: has another size than {photographs[0].path.name}; keep one camera setting")
        found = _checkerboard(image, squares) or _color_checker(image)
        boards += [] if found is None else [found]
    if len(boards) < _LEAST_BOARDS or size is None:
        raise CaptureError(
            f"{folder}: {len(boards)} of {len(photographs)} photographs show a board, {_LEAST_BOARDS} are needed: a "
            f"checkerboard of {squares[0]}×{squares[1]} inner corners (--board) or a ColorChecker, all of it in view"
        )
    return _fit_lens(boards, size, photographs[0], folder.name)


def _fit_lens(boards: list[BoardView], size: tuple[int, int], first: Photograph, folder: str) -> LensGeometry:
    """Fit focal length, distortion and, if they determine it, principal point. Raises CaptureError: too uncertain."""
    pinhole = _bundle_adjustment(boards, size, _MODEL | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2)[0]
    residual, camera, coefficients, sigma = _bundle_adjustment(boards, size, _MODEL)
    principal_known = float(np.hypot(sigma[2], sigma[3])) < _MOST_PRINCIPAL_SIGMA * size[0]
    if not principal_known:
        residual, camera, coefficients, sigma = _bundle_adjustment(boards, size, _MODEL | cv2.CALIB_FIX_PRINCIPAL_POINT)
    focal = float(camera[0, 0])
    focal_sigma = float(max(sigma[:2]))  # one of the two, where their ratio is fixed
    if not focal_sigma < _MOST_FOCAL_SIGMA * focal:
        raise CaptureError(
            f"{folder}: the focal length is known to {100 * focal_sigma / focal:.1f} %, the limit is "
            f"{100 * _MOST_FOCAL_SIGMA:g} %; photograph the board tilted by 30° and more to all sides, "
            "in all corners of the picture"
        )
    lens = Distortion(focal, (float(camera[0, 2]), float(camera[1, 2])), float(coefficients[0]), float(coefficients[1]))
    if distortion.folds(lens, *size):
        raise CaptureError(
            f"{folder}: the fitted distortion folds the picture's corners over; photograph the board in all corners, "
            "and use no fisheye lens"
        )
    if residual > _MOST_RESIDUAL:
        raise CaptureError(
            f"{folder}: the corners lie {residual:.2f} px (rms) from those of a flat board, the limit is "
            f"{_MOST_RESIDUAL:g} px; use a flat, sharp board, and no fisheye lens"
        )
    return LensGeometry(
        focal_px=lens.focal,
        focal_sigma_px=focal_sigma,
        principal_px=lens.center,
        principal_sigma_px=float(np.hypot(sigma[2], sigma[3])) if principal_known else 0.0,
        k1=lens.k1,
        k1_sigma=float(sigma[4]),
        k2=lens.k2,
        k2_sigma=float(sigma[5]),
        size_px=size,
        residual_px=residual,
        pinhole_residual_px=pinhole,
        photographs=len(boards),
        board=boards[0].name,
        focal_length_mm=first.exif.focal_length_mm,
    )


def _bundle_adjustment(
    boards: list[BoardView], size: tuple[int, int], flags: int
) -> tuple[float, Floats, Floats, Floats]:
    """Fit the camera to the board's points by bundle adjustment.

    Returns rms residual [px], camera matrix (3, 3), distortion k₁ k₂ …, and 1σ of fx fy cx cy k₁ k₂ ….
    """
    width, height = size
    guess = np.array([[_NORMAL * width, 0, (width - 1) / 2], [0, _NORMAL * width, (height - 1) / 2], [0, 0, 1]])
    result: Any = cv2.calibrateCameraExtended(
        [one.flat for one in boards],
        [one.seen for one in boards],
        size,
        guess,
        np.zeros(5),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10),
    )
    rms, camera, coefficients, _, _, sigma = result[:6]
    return float(rms), np.asarray(camera), np.asarray(coefficients).ravel(), np.asarray(sigma).ravel()


def _checkerboard(image: SensorImage, squares: tuple[int, int]) -> BoardView | None:
    """Detect a checkerboard's inner corners, row by row, refined in linear light (gamma would move edges)."""
    found, corners = cv2.findChessboardCornersSB(_gray(image), squares, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    grid = np.reshape(corners, (squares[1], squares[0], 2)).astype(np.float32)
    spacing = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
    window = int(np.clip(_WINDOW * spacing, 2, _MOST_WINDOW_PX))
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    placed = cv2.cornerSubPix(_green(image), grid.reshape(-1, 1, 2), (window, window), (-1, -1), stop)
    down, across = np.mgrid[: squares[1], : squares[0]].reshape(2, -1)
    flat = np.stack([across, down, np.zeros_like(down)], axis=-1).astype(np.float32)
    return BoardView(flat, _on_raw(placed.reshape(-1, 2), image), f"checkerboard {squares[0]}×{squares[1]}")


def _gray(image: SensorImage) -> NDArray[np.uint8]:
    """8-bit picture (H, W) with a display's gamma for the corner detector; highlights are clipped."""
    green = _green(image)
    light = np.clip(green / max(float(np.quantile(green, 0.98)), 1e-6), 0, 1)
    return np.asarray(255 * light ** (1 / 2.2), np.uint8)


def _green(image: SensorImage) -> Floats:
    """The linear green channel (H, W) of a photograph, or its only channel."""
    value = sensor.signal(image)
    return np.ascontiguousarray(value[..., min(1, value.shape[-1] - 1)], np.float32)


def _color_checker(image: SensorImage) -> BoardView | None:
    """Detect a ColorChecker: centers of the patches that are brighter than the card."""
    value = sensor.signal(image)
    if value.shape[-1] != 3:
        return None
    try:
        found = whitebalance.measure(
            _as_stack(value, image), shipped_data.colorchecker(), ChartRequest("auto"), WhitebalanceSettings()
        )
    except ChartError:
        return None
    if found.place is None:
        return None
    place, flat, seen = chart.from_corners(found.place.corners).homography, [], []
    light = np.asarray(value.sum(axis=-1), np.float32)
    for center in chart.centers():
        point = _patch_center(light, place, center)
        if point is not None:
            flat.append([*center, 0.0])
            seen.append(point)
    if len(seen) < len(chart.centers()) / 2:
        return None
    return BoardView(np.array(flat, np.float32), _on_raw(np.array(seen), image), "ColorChecker")


def _patch_center(light: Floats, place: Floats, center: Floats) -> Floats | None:
    """Center (2,) px of a patch near chart coordinates `center`.

    None if the patch is at the picture's edge, or hardly brighter than the card between the patches. `place` (3, 3) is
    the homography from chart coordinates to px. The center is the centroid of the light above the card's, computed in
    chart coordinates, so that tilt does not move it.
    """
    offset = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    distance = np.maximum(np.abs(offset)[:, None], np.abs(offset))
    # the border of the window, the middle of the patch, and all that can be patch
    card_at, patch_at, counted = distance > 0.5 - _CARD, distance < 0.25, distance < 0.5 - _CARD / 2
    at = np.array(center)
    for _ in range(_ITERATIONS):
        grid = np.stack(np.meshgrid(at[0] + offset, at[1] + offset), axis=-1)
        px = transform_points(place, grid).astype(np.float32)
        if px.min() < 0 or (px.max(axis=(0, 1)) > np.array(light.shape[::-1]) - 1).any():
            return None
        window = cv2.remap(light, px[..., 0], px[..., 1], cv2.INTER_LINEAR)
        card, patch = float(np.median(window[card_at])), float(np.median(window[patch_at]))
        if patch < _LEAST_CONTRAST * max(card, 1e-6):
            return None
        light_above = np.where(counted, np.clip((window - card) / (patch - card), 0, 1), 0)
        at = np.array([(light_above * grid[..., k]).sum() / light_above.sum() for k in (0, 1)])
    return np.asarray(transform_points(place, at))


def _as_stack(value: Floats, image: SensorImage) -> AngleStack:
    """Wrap one picture (H, W, 3) to find a chart by `stages/whitebalance`; variance and lens have no effect there."""
    height, width = value.shape[:2]
    return AngleStack(
        value=value[None],
        variance=np.full((1, height, width, 3), 1e-6, np.float32),
        quality=np.zeros((1, height, width), np.uint8),
        angle=np.zeros(1),
        view=View(_NORMAL * width, ((width - 1) / 2, (height - 1) / 2), float(image.superpixel)),
        bracket=single_frames(1),
        sensor=ColorSensor(image.camera_matrix, image.white_balance),
    )


def _on_raw(points: Floats, image: SensorImage) -> Floats:
    """Convert points (N, 2) from binned px to visible RAW px, float32 for cv2."""
    return np.asarray(from_grid(points, image.superpixel), np.float32)
