"""In: photographs of a checkerboard or a ColorChecker from all sides. Out: the focal length and the lens's distortion.

A flat board seen at several tilts fixes the camera (Zhang); OpenCV's bundle adjustment solves it. Corners of a
checkerboard are found by OpenCV; of a ColorChecker the middles of its patches serve, which blur does not move.

References
----------
Zhang, A flexible new technique for camera calibration, IEEE TPAMI 2000; Brown, Photogrammetric Engineering 1971.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.calibrate.photographs import Photograph
from polcap.calibration_values import LensGeometry
from polcap.errors import CaptureError, ChartError
from polcap.formats import calib
from polcap.images import AngleStack, ChartRequest, Distortion, Floats, SensorImage, View
from polcap.optics import distortion, sensor
from polcap.stages import whitebalance
from polcap.stages.whitebalance import chart

_LEAST_BOARDS = 6  # three tilts fix a pinhole; twice that tells how well
_MOST_FOCAL_SIGMA = 0.01  # relative; beyond, EXIF knows better
_MOST_RESIDUAL = 1.5  # RAW px rms; a board that is flat and sharp leaves a tenth
_MOST_PRINCIPAL_SIGMA = 0.004  # of the width; known less well, the principal point stays in the middle
_WINDOW, _MOST_WINDOW_PX = 0.3, 6  # half side of what places a corner: of a square's side; its greatest, px
_SAMPLES = 31  # across a patch and half the gaps beside it, where its middle is measured
_LEAST_CONTRAST = 2.0  # patch over card
_CARD = 0.06  # of the window's side, each side: the card, as seen beside a patch of 0.88 of the pitch
_TURNS = 6  # of the window after the middle, until it stands
_ALIKE = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3


@dataclass(frozen=True)
class Board:
    """What one photograph shows of a board."""

    flat: Floats  # (N, 3) float32 places on the board, in squares or patches; z = 0
    seen: Floats  # (N, 2) float32 RAW px
    name: str


def measure(photographs: list[Photograph], squares: tuple[int, int]) -> LensGeometry:
    """Focal length, principal point, k₁ and k₂ with their 1σ.

    Parameters
    ----------
    photographs
        Of one board, it or the camera turned between them.
    squares
        Inner corners of the checkerboard, across and down.

    Raises
    ------
    CaptureError
        Too few show a board, or all face it alike, or their corners do not lie as a flat board's.
    """
    folder = photographs[0].path.parent
    boards: list[Board] = []
    size: tuple[int, int] | None = None
    for one in photographs:
        image = one.image()
        here = image.value.shape[1], image.value.shape[0]
        size = size or here
        if here != size:
            raise CaptureError(f"{one.path}: has another size than {photographs[0].path.name}; keep one camera setting")
        found = _checkerboard(image, squares) or _color_checker(image)
        boards += [] if found is None else [found]
    if len(boards) < _LEAST_BOARDS or size is None:
        raise CaptureError(
            f"{folder}: {len(boards)} of {len(photographs)} photographs show a board, {_LEAST_BOARDS} are needed: a "
            f"checkerboard of {squares[0]}×{squares[1]} inner corners (--board) or a ColorChecker, all of it in view"
        )
    return _solved(boards, size, photographs[0], folder.name)


def _solved(boards: list[Board], size: tuple[int, int], first: Photograph, folder: str) -> LensGeometry:
    pinhole = _adjusted(boards, size, _ALIKE | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2)[0]
    residual, camera, bend, sigma = _adjusted(boards, size, _ALIKE)
    free = float(np.hypot(sigma[2], sigma[3])) < _MOST_PRINCIPAL_SIGMA * size[0]
    if not free:
        residual, camera, bend, sigma = _adjusted(boards, size, _ALIKE | cv2.CALIB_FIX_PRINCIPAL_POINT)
    px = float(camera[0, 0])
    focal_sigma = float(max(sigma[:2]))  # one of the two, where their ratio is fixed
    if not focal_sigma < _MOST_FOCAL_SIGMA * px:
        raise CaptureError(
            f"{folder}: the focal length is known to {100 * focal_sigma / px:.1f} %, the limit is "
            f"{100 * _MOST_FOCAL_SIGMA:g} %; photograph the board tilted by 30° and more to all sides, "
            "in all corners of the picture"
        )
    lens = Distortion(px, (float(camera[0, 2]), float(camera[1, 2])), float(bend[0]), float(bend[1]))
    if residual > _MOST_RESIDUAL or distortion.folds(lens, *size):
        raise CaptureError(
            f"{folder}: the corners lie {residual:.2f} px (rms) from those of a flat board, the limit is "
            f"{_MOST_RESIDUAL:g} px; use a flat, sharp board, and no fisheye lens"
        )
    return LensGeometry(
        focal_px=lens.focal,
        focal_sigma_px=focal_sigma,
        principal_px=lens.center,
        principal_sigma_px=float(np.hypot(sigma[2], sigma[3])) if free else 0.0,
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


def _adjusted(boards: list[Board], size: tuple[int, int], flags: int) -> tuple[float, Floats, Floats, Floats]:
    """Rms residual [px], camera (3, 3), k₁ k₂ …, 1σ of fx fy cx cy k₁ k₂ …, by cv2's bundle adjustment."""
    width, height = size
    guess = np.array([[1.4 * width, 0, (width - 1) / 2], [0, 1.4 * width, (height - 1) / 2], [0, 0, 1]])
    answer: Any = cv2.calibrateCameraExtended(
        [one.flat for one in boards],
        [one.seen for one in boards],
        size,
        guess,
        np.zeros(5),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10),
    )
    rms, camera, bend, _, _, sigma = answer[:6]
    return float(rms), np.asarray(camera), np.asarray(bend).ravel(), np.asarray(sigma).ravel()


def _checkerboard(image: SensorImage, squares: tuple[int, int]) -> Board | None:
    """Its inner corners, row by row, placed anew in linear light: gamma moves edges."""
    found, corners = cv2.findChessboardCornersSB(_gray(image), squares, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    grid = np.reshape(corners, (squares[1], squares[0], 2)).astype(np.float32)
    apart = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
    window = int(np.clip(_WINDOW * apart, 2, _MOST_WINDOW_PX))
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    placed = cv2.cornerSubPix(_green(image), grid.reshape(-1, 1, 2), (window, window), (-1, -1), stop)
    down, across = np.mgrid[: squares[1], : squares[0]].reshape(2, -1)
    flat = np.stack([across, down, np.zeros_like(down)], axis=-1).astype(np.float32)
    return Board(flat, _on_raw(placed.reshape(-1, 2), image), f"checkerboard {squares[0]}×{squares[1]}")


def _gray(image: SensorImage) -> NDArray[np.uint8]:
    """As 8 bits of a display."""
    green = _green(image)
    light = np.clip(green / max(float(np.quantile(green, 0.98)), 1e-6), 0, 1)
    return np.asarray(255 * light ** (1 / 2.2), np.uint8)


def _green(image: SensorImage) -> Floats:
    """Signals (H, W) of green, or of the only channel."""
    value = sensor.signal(image)
    return np.ascontiguousarray(value[..., min(1, value.shape[-1] - 1)], np.float32)


def _color_checker(image: SensorImage) -> Board | None:
    """The middles of its patches that stand out from the card."""
    value = sensor.signal(image)
    if value.shape[-1] != 3:
        return None
    try:
        found = whitebalance.measure(
            _as_stack(value, image), calib.colorchecker(), ChartRequest("auto"), whitebalance.WhitebalanceSettings()
        )
    except ChartError:
        return None
    if found.corners is None:
        return None
    place, at, seen = chart.from_corners(found.corners).homography, [], []
    light = np.asarray(value.sum(axis=-1), np.float32)
    for center in chart.centers():
        middle = _middle(light, place, center)
        if middle is not None:
            at.append([*center, 0.0])
            seen.append(middle)
    if len(seen) < len(chart.centers()) / 2:
        return None
    return Board(np.array(at, np.float32), _on_raw(np.array(seen), image), "ColorChecker")


def _middle(light: Floats, place: Floats, center: Floats) -> Floats | None:
    """The middle (2,) px of a patch near chart coordinates `center`; None where it hardly stands out from the card.

    It is the centre of what is brighter than the card around, in chart coordinates, so that tilt does not move it.
    """
    step = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    far = np.maximum(np.abs(step)[:, None], np.abs(step))
    card_at, patch_at, counted = far > 0.5 - _CARD, far < 0.25, far < 0.5 - _CARD / 2
    at = np.array(center)
    for _ in range(_TURNS):
        grid = np.stack(np.meshgrid(at[0] + step, at[1] + step), axis=-1)
        px = chart.project(place, grid).astype(np.float32)
        if px.min() < 0 or (px.max(axis=(0, 1)) > np.array(light.shape[::-1]) - 1).any():
            return None
        window = cv2.remap(light, px[..., 0], px[..., 1], cv2.INTER_LINEAR)
        card, patch = float(np.median(window[card_at])), float(np.median(window[patch_at]))
        if patch < _LEAST_CONTRAST * max(card, 1e-6):
            return None
        over = np.where(counted, np.clip((window - card) / (patch - card), 0, 1), 0)
        at = np.array([(over * grid[..., k]).sum() / over.sum() for k in (0, 1)])
    return np.asarray(chart.project(place, at))


def _as_stack(value: Floats, image: SensorImage) -> AngleStack:
    """One picture (H, W, 3) as the stage that knows charts takes it."""
    height, width = value.shape[:2]
    return AngleStack(
        value=value[None],
        variance=np.full((1, height, width, 3), 1e-6, np.float32),
        quality=np.zeros((1, height, width), np.uint8),
        angle=np.zeros(1),
        view=View(1.4 * width, ((width - 1) / 2, (height - 1) / 2), float(image.superpixel)),
        exposure_ratio=np.ones((1, 1, 3)),
        exif_ratio=np.ones((1, 1)),
        ghost_fraction=np.zeros(1),
        lossy=False,
        camera_matrix=image.camera_matrix,
        white_balance=image.white_balance,
    )


def _on_raw(points: Floats, image: SensorImage) -> Floats:
    """Points (N, 2) of the binned grid in visible RAW px, as cv2 takes them."""
    side = image.superpixel
    return np.asarray(side * points + (side - 1) / 2, np.float32)
