"""Object probability by the mask network: on the whole picture, then twice on the part with the object.

Pictures are averaged down before registration, so the time does not grow with the sensor's size.
"""

from functools import partial

import cv2
import numpy as np

from polcap import parallel
from polcap.chart_values import ColorCalibration
from polcap.image_values import Bits, Floats
from polcap.optics import mueller
from polcap.optics.resize import area_mean
from polcap.optics.warp import Box, warp
from polcap.stage_values import Alignment, AngleStack, Network, RunNetwork
from polcap.stages.mask.likely_regions import box_around
from polcap.stages.mask.mask_channels import SIZE_MULTIPLE, ReducedPicture, brightness, encode, mirror

_CLOSE_UP_PX = 256  # greatest longer side of a close-up
_CLOSE_UPS = 2  # passes over the part with the object; the second adds parts that the first estimate lacked
_MARGIN = 0.12  # around that part, of its longer side
_LIKELY = 0.3  # least probability of pixels that a close-up must include
_LEAST_GAIN = 0.02  # of a shot; a darker one shows its noise only
_POLARIZED = 0.08  # a gain nearer to 1 may be polarized surroundings; errors from 0.25 on made masks wrong
_MIRRORS = ((), (0,), (1,), (0, 1))  # axes of the mirror images that are averaged (decision 15)


def object_probability(
    radiance: AngleStack, alignment: Alignment, color: ColorCalibration, chart: Bits, network: Network, run: RunNetwork
) -> Floats:
    """Probability (H, W) 0…1 that a pixel of the reference shot is the object; `chart` (H, W) is 1 on the chart."""
    height, width = chart.shape
    whole = (0, 0, width, height)
    picture = reduced_picture(radiance, alignment, color, chart, whole, int(network.metadata["native_size"]))
    bright = brightness(picture.color)
    out = cv2.resize(_run(network, run, encode(picture, bright)), (width, height))
    for _ in range(_CLOSE_UPS):
        box = box_around(out > _LIKELY, _MARGIN, least=8)
        if box is None:
            break
        x0, y0, x1, y1 = box
        picture = reduced_picture(radiance, alignment, color, chart, box, _CLOSE_UP_PX)
        estimate = area_mean(out[y0:y1, x0:x1], picture.chart.shape)
        out = np.minimum(out, _LIKELY)  # outside the box
        close_up = _run(network, run, encode(picture, bright, estimate))
        out[y0:y1, x0:x1] = cv2.resize(close_up, (x1 - x0, y1 - y0))
    return np.asarray(out)


def reduced_picture(
    radiance: AngleStack, alignment: Alignment, color: ColorCalibration, chart: Bits, box: Box, longest: int
) -> ReducedPicture:
    """Input picture of the mask network: a box of the reference shot, averaged down to at most `longest` px a side.

    `chart` (H, W) is 1 on the chart.
    """
    x0, y0, x1, y1 = box
    scale = max(1.0, max(x1 - x0, y1 - y0) / longest)
    width, height = round((x1 - x0) / scale), round((y1 - y0) / scale)
    sx, sy = (x1 - x0) / width, (y1 - y0) / height
    to_grid = np.array([[sx, 0, x0 + (sx - 1) / 2], [0, sy, y0 + (sy - 1) / 2], [0, 0, 1]])  # reduced px → merged px
    shots = []
    for value, transform in zip(radiance.value, alignment.transform):
        small = area_mean(value[y0:y1, x0:x1].astype(np.float32), (height, width))
        shots.append(warp(small, np.linalg.inv(to_grid) @ transform @ to_grid, order=1))
    solve = np.linalg.pinv(mueller.analyzer(np.asarray(radiance.angle, np.float64))) / _coarse_gains(radiance)  # (3, K)
    stokes = np.einsum("sk,khwc->shwc", solve, np.stack(shots)).astype(np.float32)
    sums = stokes @ color.matrix.sum(axis=0).astype(np.float32)  # of linear Rec.709's channels
    full_height, full_width = chart.shape
    x = 2 * (sx * (np.arange(width) + 0.5) + x0) / full_width - 1
    y = 2 * (sy * (np.arange(height) + 0.5) + y0) / full_height - 1
    return ReducedPicture(
        color=stokes[0] @ color.matrix.T.astype(np.float32),
        stokes=sums,
        chart=area_mean(chart[y0:y1, x0:x1].astype(np.float32), (height, width)) > 0.5,
        place=np.stack(np.meshgrid(x, y)).astype(np.float32),
    )


def _coarse_gains(radiance: AngleStack) -> Floats:
    """Gains (K,) of the shots, median over the brighter half of the picture.

    The gain is 1 if the change may be polarization, for a black shot, and for all angles of one exposure.
    """
    if radiance.offset_px is not None:
        return np.ones(len(radiance.value))
    light = radiance.value[:, ::8, ::8].sum(-1, dtype=np.float64)
    light = light[:, light[0] > max(np.median(light[0]), 0)]
    gain = np.median(light / light[0], axis=1) if light.size else np.ones(len(light))
    return np.where((np.abs(gain - 1) > _POLARIZED) & (gain > _LEAST_GAIN), gain, 1)


def _run(network: Network, run: RunNetwork, channels: Floats) -> Floats:
    """Run the mask network on channels (11, H, W) and their mirror images: probability (H, W) of the mean logit."""
    logits = parallel.results([partial(_logit, network, run, channels, axes) for axes in _MIRRORS], network.at_once)
    return np.asarray(1 / (1 + np.exp(-np.mean(logits, axis=0))), np.float32)


def _logit(network: Network, run: RunNetwork, channels: Floats, axes: tuple[int, ...]) -> Floats:
    """The mask network's logit (H, W) for the picture mirrored along these axes, mirrored back."""
    height, width = channels.shape[1:]
    padding = [(0, -n % SIZE_MULTIPLE) for n in (height, width)]
    padded = np.pad(mirror(channels, axes), [(0, 0), *padding], mode="edge")
    logit = run(network, padded[None])["logit"][0, 0, :height, :width]
    return np.flip(np.clip(logit, -30, 30), axes)
