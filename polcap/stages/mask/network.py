"""How likely each pixel is the object, by a network that looks at the whole picture, then at what it found.

The pictures are reduced before they are aligned and resampled, so the time goes with what the network sees and
not with the sensor.
"""

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Alignment, AngleStack, ColorCalibration, Floats, Network, RunNetwork
from polcap.optics import mueller
from polcap.optics.resize import area_mean
from polcap.optics.warp import warp
from polcap.stages.mask.mask_channels import SIZE_MULTIPLE, Look, brightness, encode, mirrored

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 full-frame grid px, end exclusive
_FINE = 256  # px of the second look's longer side, at most
_AGAIN = 2  # looks at what was found; what the hint lacked is found from there
_ROOM = 0.12  # shown around what the first look found, of its longer side
_LIKELY = 0.3  # of being the object, for a pixel to be shown to the second look
_MIRRORED = ((), (0,), (1,), (0, 1))  # axes along which a look is turned round (decision 15)


def chances(
    radiance: AngleStack, alignment: Alignment, color: ColorCalibration, chart: NDArray[np.uint8], network: Network,
    run: RunNetwork,
) -> Floats:  # fmt: skip
    """Chance (H, W) 0…1 of each pixel of the reference grid to be the object.

    Parameters
    ----------
    radiance, alignment, color
        As in `segment`.
    chart
        (H, W) 1 where the chart lies.
    network
        Looks at the whole picture, then again at what it found.
    run
        Runs a network.
    """
    height, width = chart.shape
    whole = (0, 0, width, height)
    longest = int(network.metadata["native_size"])
    seen = look(radiance, alignment, color, chart, whole, longest)
    bright = brightness(seen.color)
    found = _run(network, run, encode(seen, bright))
    out = _resized(found, whole)
    for _ in range(_AGAIN):
        box = around(out > _LIKELY)
        if box is None:
            break
        x0, y0, x1, y1 = box
        seen = look(radiance, alignment, color, chart, box, _FINE)
        hint = area_mean(out[y0:y1, x0:x1], seen.chart.shape)
        out = np.minimum(out, _LIKELY)  # of what lies beyond the box
        out[y0:y1, x0:x1] = _resized(_run(network, run, encode(seen, bright, hint)), box)
    return out


def look(
    radiance: AngleStack, alignment: Alignment, color: ColorCalibration, chart: NDArray[np.uint8], box: Box,
    longest: int,
) -> Look:  # fmt: skip
    """What the aligned shots show in a box, averaged down.

    Parameters
    ----------
    radiance, alignment, color
        As in `chances`.
    chart
        (H, W) 1 where the chart lies.
    box
        x0, y0, x1, y1 px of the reference grid.
    longest
        Greatest side of the answer, px.
    """
    x0, y0, x1, y1 = box
    scale = max(1.0, max(x1 - x0, y1 - y0) / longest)
    width, height = round((x1 - x0) / scale), round((y1 - y0) / scale)
    sx, sy = (x1 - x0) / width, (y1 - y0) / height
    there = np.array([[sx, 0, x0 + (sx - 1) / 2], [0, sy, y0 + (sy - 1) / 2], [0, 0, 1]])  # reduced px → grid px
    shots = []
    for value, transform in zip(radiance.value, alignment.transform):
        small = area_mean(value[y0:y1, x0:x1], (height, width))
        shots.append(warp(small, np.linalg.inv(there) @ transform @ there, order=1))
    solve = np.linalg.pinv(mueller.analyzer(np.asarray(radiance.angle, np.float64)))  # (3, K)
    stokes = np.einsum("sk,khwc->shwc", solve, np.stack(shots)).astype(np.float32)
    seen = stokes[0] @ color.matrix.T.astype(np.float32)
    sums = stokes @ color.matrix.sum(axis=0).astype(np.float32)  # of linear Rec.709's channels
    full_h, full_w = chart.shape
    x = 2 * (sx * (np.arange(width) + 0.5) + x0) / full_w - 1
    y = 2 * (sy * (np.arange(height) + 0.5) + y0) / full_h - 1
    on_chart = area_mean(chart[y0:y1, x0:x1].astype(np.float32), (height, width)) > 0.5
    return Look(seen, sums, on_chart, np.stack(np.meshgrid(x, y)).astype(np.float32))


def around(likely: NDArray[np.bool_]) -> Box | None:
    """The box of the pixels (H, W) that count, with room around it, within the picture; None where there are none."""
    rows, columns = np.flatnonzero(likely.any(1)), np.flatnonzero(likely.any(0))
    if not len(rows):
        return None
    room = max(8, round(_ROOM * max(np.ptp(rows), np.ptp(columns))))
    height, width = likely.shape
    return (
        max(int(columns[0]) - room, 0), max(int(rows[0]) - room, 0),
        min(int(columns[-1]) + 1 + room, width), min(int(rows[-1]) + 1 + room, height),
    )  # fmt: skip


def _run(network: Network, run: RunNetwork, channels: Floats) -> Floats:
    """The chance at each pixel, (H, W), of channels of any size: mean logit of the picture and its mirror images."""
    logits = parallel.results([partial(_logit, network, run, channels, axes) for axes in _MIRRORED], network.at_once)
    total = np.zeros(channels.shape[1:], np.float32)
    for logit in logits:
        total += logit / len(_MIRRORED)
    return np.asarray(1 / (1 + np.exp(-total)), np.float32)


def _logit(network: Network, run: RunNetwork, channels: Floats, axes: tuple[int, ...]) -> Floats:
    """What the network answers to the picture mirrored along these axes, mirrored back, (H, W)."""
    height, width = channels.shape[1:]
    more = [(0, -n % SIZE_MULTIPLE) for n in (height, width)]
    shown = np.pad(mirrored(channels, axes), [(0, 0), *more], mode="edge")
    logit = run(network, shown[None])["logit"][0, 0, :height, :width]
    return np.flip(np.clip(logit, -30, 30), axes)


def _resized(image: Floats, box: Box) -> Floats:
    x0, y0, x1, y1 = box
    return np.asarray(cv2.resize(image, (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR))
