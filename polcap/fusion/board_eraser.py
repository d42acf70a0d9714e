"""Erases the board's print from a view's picture, so that the object's mask is found as before a dark backdrop.

The pose gives the places of paper and ink. Their brightness is fitted by smooth functions over the board. Pixels like
the print then get the brightness of ink. Parts of the object that are as bright as the paper behind them are lost at
first. Paper is printed in narrow strips only, so a closing over the width of a strip restores these parts.
"""

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import maximum_filter

from polcap.chart_values import ColorCalibration
from polcap.fusion.poses import SessionCamera
from polcap.fusion.values import Pose
from polcap.image_values import Bools, Floats, Quality
from polcap.optics import board as boards
from polcap.optics import distortion
from polcap.optics.board import Board
from polcap.optics.projection import back_project, from_grid
from polcap.stage_values import Alignment, AngleStack
from polcap.stages.mask import mean_picture

_SAMPLES = 4  # per pixel side, for the share of paper
_SITE_PX = 0.8  # side of the area that a channel's photosites and the lens's blur average over
_SHIFT_PX = 0.25  # error of the print's position in the picture
_TOLERANCE = 0.2  # relative, of a channel's brightness against the print's
_NOISE = 0.02  # of the paper's brightness: noise and scattered light
_BEYOND = 1.02  # half widths of the page within which pixels are erased: the paper's edge is not sharp
_ROUNDS = 8  # of the fit of the brightness, each without pixels that deviate: those of the object
_SPECK = 0.25  # area in squares; smaller parts in front of the board are noise
_STRIP = 1 / boards.CELLS  # width of the strips of paper, in squares


@dataclass(frozen=True)
class PosedBoard:
    """A board before the camera of a session."""

    board: Board
    camera: SessionCamera
    pose: Pose


@dataclass(frozen=True)
class _Print:
    """The board in the merged picture of a view."""

    place: Floats  # (H, W, 2) x, z on the board, in half sides: −1…1 is printed
    paper: Floats  # (H, W, 3) share of paper in a pixel of each channel, whose photosites lie side by side
    doubt: Floats  # (H, W, 3) error of this share from errors of the position

    @property
    def from_middle(self) -> Floats:
        """Larger coordinate (H, W) of a pixel's place, in half sides."""
        return np.asarray(np.abs(self.place).max(axis=-1))


@dataclass(frozen=True)
class _PrintLight:
    """Brightness of the print in the picture, extended beyond the board."""

    paper: Floats  # (H, W, 1)
    ink: Floats  # (H, W, 1)
    tint: Floats  # (3,) color of both, mean 1


def erase(radiance: AngleStack, alignment: Alignment, color: ColorCalibration, posed: PosedBoard) -> AngleStack:
    """A copy of the merged shots in which the visible print of the board is as dark as its ink, and flagged ERASED.

    Where the board is not in the picture, or hidden, nothing changes.
    """
    board, print_ = posed.board, _project(radiance, posed)
    picture = mean_picture(radiance, alignment, color)
    covered = print_.from_middle <= _BEYOND * board.page_m[0] / board.side_m
    if not covered.any():
        return radiance
    light = _fit_light(picture, print_)
    erased = covered & ~_find_object(picture / light.tint, print_, light, _strip_px(print_, board))
    white = np.linalg.inv(np.asarray(color.matrix, np.float64)) @ light.tint
    ink = (0.5 * light.ink * white).astype(np.float32)  # a shot has half of S0
    value = np.where(erased[..., None], ink, radiance.value)
    quality = radiance.quality | np.where(erased, np.uint8(Quality.ERASED), np.uint8(0))
    return replace(radiance, value=value, quality=quality, mosaic=None)


def _project(radiance: AngleStack, posed: PosedBoard) -> _Print:
    """Place and share of paper of each pixel of the merged picture, through the pose of the board."""
    board = posed.board
    height, width = radiance.value.shape[1:3]
    scale = radiance.view.scale
    y, x = (from_grid(axis, scale) for axis in np.mgrid[:height, :width].astype(np.float64))
    place = _on_board(posed.camera, posed.pose, x, y)
    on_page = np.abs(place).max(axis=-1) <= board.page_m[0] / 2
    down, across = (np.gradient(place, axis=axis)[on_page] for axis in (0, 1))  # m on the board per pixel
    steps = _SITE_PX * ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5)
    sites = np.zeros((3, 2)) if radiance.sensor.site_px is None else radiance.sensor.site_px
    paper: Floats = np.zeros((height, width, 3))
    for channel, (site_x, site_y) in enumerate(sites):
        total = sum(
            ~boards.is_ink(board, *(place[on_page] + (site_x + dx) * across + (site_y + dy) * down).T)
            for dx, dy in itertools.product(steps, steps)
        )
        paper[on_page, channel] = total / _SAMPLES**2
    slope = np.hypot(np.gradient(paper, axis=0), np.gradient(paper, axis=1))  # per pixel
    return _Print(2 * place / board.side_m, paper, _SHIFT_PX * maximum_filter(slope, (3, 3, 1)))


def _on_board(camera: SessionCamera, pose: Pose, x: Floats, y: Floats) -> Floats:
    """Points x, z (H, W, 2) [m] of the board's plane that RAW pixels show; above its horizon, some 1e6 m away."""
    ray = back_project(camera.view, *distortion.undistort(camera.lens, x, y)) @ pose.rotation  # world frame
    start = pose.center
    down = np.where(ray[..., 1] < -1e-6, -ray[..., 1], np.nan)
    reach = np.nan_to_num(start[1] / down, nan=1e6)
    return np.asarray(start[[0, 2]] + ray[..., [0, 2]] * reach[..., None])


def _fit_light(picture: Floats, print_: _Print) -> _PrintLight:
    """Brightness of paper (quadratic over the board) and of ink (linear), fitted without pixels that deviate."""
    ring = (print_.from_middle < 1) & (print_.from_middle > 1 - 2 * boards.RING / boards.SQUARES)
    gray, share = picture.mean(axis=-1)[ring].astype(np.float64), print_.paper[ring].mean(axis=-1)
    base = _quadratic(print_.place[ring])
    terms = np.concatenate([base * share[:, None], base[:, :3] * (1 - share)[:, None]], axis=1)
    use = np.ones(len(gray), bool)
    for _ in range(_ROUNDS):
        weight, *_ = np.linalg.lstsq(terms[use], gray[use], rcond=None)
        error = np.abs(terms @ weight - gray)
        use = error < max(3 * 1.48 * float(np.median(error)), 1e-9)  # three robust standard deviations
    everywhere = _quadratic(np.clip(print_.place, -1.5, 1.5))  # not extrapolated farther
    paper, ink = everywhere @ weight[:6], everywhere[..., :3] @ weight[6:]
    bright = gray[use & (share > 0.8)]  # nearly all paper
    level = float(np.median(bright)) if len(bright) else float(gray.max())
    colors = picture[ring][use & (share > 0.6)]  # mostly paper
    tint = np.median(colors, axis=0) if len(colors) else np.ones(3)
    paper, ink = np.maximum(paper, 0.1 * level), np.maximum(ink, 1e-3 * level)  # `level` is that of paper
    return _PrintLight(paper[..., None], ink[..., None], np.asarray(tint / tint.mean()))


def _quadratic(place: Floats) -> Floats:
    """Values (..., 6) of 1, x, z, x², x z, z²."""
    x, z = place[..., 0], place[..., 1]
    return np.stack([np.ones_like(x), x, z, x * x, x * z, z * z], axis=-1)


def _strip_px(print_: _Print, board: Board) -> tuple[int, int]:
    """Width of the print's strips of paper in the picture: across, and down [px]."""
    slope = [np.hypot(*np.moveaxis(np.gradient(print_.place, axis=axis), -1, 0)) for axis in (1, 0)]
    inside, half_side = print_.from_middle < 1, 0.5 * board.side_m
    across, down = (max(float(np.median(s[inside])) * half_side, 1e-9) for s in slope)  # m per pixel
    strip = _STRIP * board.square_m
    return int(np.ceil(strip / across)), int(np.ceil(strip / down))


def _find_object(picture: Floats, print_: _Print, light: _PrintLight, strip: tuple[int, int]) -> Bools:
    """Pixels (H, W) that differ from the print, closed over the strips of paper, without lines and specks."""
    expected = print_.paper * (light.paper - light.ink) + light.ink
    limit = _TOLERANCE * expected + (print_.doubt + _NOISE) * light.paper
    differs = (np.abs(picture - expected) > limit).any(axis=-1)
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (strip[0] // 2) + 1, 2 * (strip[1] // 2) + 1))
    pair = np.ones((2, 2), np.uint8)  # removes edges of the print; with one anchor for both, the result would shift
    broad = cv2.dilate(cv2.erode(differs.astype(np.uint8), pair, anchor=(0, 0)), pair, anchor=(1, 1))
    closed = cv2.morphologyEx(broad, cv2.MORPH_CLOSE, element)
    thick = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, label, stats, _ = cv2.connectedComponentsWithStats(thick)
    large = stats[:, cv2.CC_STAT_AREA] > _SPECK * boards.CELLS**2 * strip[0] * strip[1]
    return np.asarray(large[label] & (thick > 0))
