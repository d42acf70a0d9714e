"""Test-time augmentation: the network's predictions in turned and mirrored positions and at several sizes, averaged.

A picture that is turned by 90° or mirrored shows a scene that is turned or mirrored. Its Stokes vectors (S1, S2) turn
by twice the angle, its rays by the angle itself. Each prediction is transformed back before the average.
"""

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np

from polcap import parallel
from polcap.errors import ModelError
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.optics.morphology import erode
from polcap.stage_values import Cues, Network, RunNetwork
from polcap.stages.cues import CHANNELS, channels
from polcap.stages.infer.highlights import LEAST_KNOWN

OUTPUTS = {"normal": 3, "depth": 1, "diffuse": 3, "specular": 3, "roughness": 1, "sigma": 1}  # channels of each map
_POSITIONS = (  # quarter turns, mirrored; the first four have all turns
    (0, False), (2, False), (1, True), (3, True), (0, True), (2, True), (1, False), (3, False),
)  # fmt: skip
_STEPS = 5  # of the median's iteration
_LEAST_ERROR = 0.5  # degrees
_NEAR_PX = 16.0  # 1σ of the means of expected errors; the sizes are weighted by these means
_POWER = 12  # the weights are these means to the power −12
_CELLS = 2.0  # cells of the network's grid, 1σ, over which its pattern is constant
BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)
_NEAREST = 0.05  # least distance between unit vectors, about 3°: nearer ones weigh the same


def predict(pictures: Sequence[Cues], network: Network, run: RunNetwork, symmetries: int) -> dict[str, Floats]:
    """The network's maps (H, W[, 3]), averaged over 1, 2, 4 or 8 rotated and mirrored positions.

    `pictures` show the same object at different sizes. The positions are dealt out to them in turn: with two pictures,
    the first gets positions 1, 3, …. The maps have the grid of the first. In a large picture the network resolves more;
    in a small one it understands textures and large forms better. A size for which it expects smaller errors than for
    the others counts more. The map `opposed` (H, W) is the share of the positions in which the normal leans to the
    other side of the ray than the mean.
    """
    first, count = pictures[0], min(len(pictures), symmetries)
    encoded = [np.moveaxis(channels(picture), 0, -1) for picture in pictures[:count]]
    calls = [
        partial(_predict_turned, encoded[k % count], pictures[k % count], network, run, *position)
        for k, position in enumerate(_POSITIONS[:symmetries])
    ]
    predictions = [
        {name: np.asarray(cv2.resize(image, first.mask.shape[::-1])) for name, image in maps.items()}
        for maps in parallel.results(calls, network.at_once)
    ]
    sizes = [_mean(predictions[k::count]) for k in range(count)]
    weights = _weights([maps["sigma"] for maps in sizes], first.mask)
    maps = {
        name: np.asarray(sum(np.einsum("yx,yx...->yx...", w, of[name]) for w, of in zip(weights, sizes)), np.float32)
        for name in OUTPUTS
    }
    normal = maps["normal"] * first.mask[..., None]
    lean = normal - frames.dot(normal, first.rays)[..., None] * first.rays  # (H, W, 3) across the ray
    opposed = np.mean([frames.dot(of["normal"], lean) < 0 for of in predictions], axis=0)
    return maps | {"normal": normal, "opposed": opposed.astype(np.float32)}


def _mean(predictions: Sequence[dict[str, Floats]]) -> dict[str, Floats]:
    """Average maps (H, W[, 3]) over positions.

    The normal is the median direction, weighted by the predicted errors: positions often differ by half a turn of the
    azimuth, and the mean of two half-turns is neither.
    """
    maps = {name: np.asarray(np.mean([of[name] for of in predictions], axis=0), np.float32) for name in OUTPUTS}
    normals, errors = (np.stack([of[name] for of in predictions]) for name in ("normal", "sigma"))
    return maps | {"normal": _median_direction(normals, errors)}


def _weights(errors: Sequence[Floats], mask: Bools) -> Floats:
    """Weights σ⁻¹² (K, H, W) of K sizes of the picture; σ is the expected error (H, W), averaged around each pixel."""
    inside = mask.astype(np.float32)
    around = np.stack([cv2.GaussianBlur(error * inside, (0, 0), _NEAR_PX) for error in errors]) + _LEAST_ERROR
    weights = (around / around.min(axis=0)) ** -_POWER
    return np.asarray(weights / weights.sum(axis=0), np.float32)


def _predict_turned(
    picture: Floats, cues: Cues, network: Network, run: RunNetwork, quarters: int, mirror: bool
) -> dict[str, Floats]:
    """Run the network on a rotated or mirrored picture (H, W, N), and transform its maps back."""
    turned = _turn_channels(_turn(picture, quarters, mirror), quarters, mirror)
    maps = run_network(np.moveaxis(turned, -1, 0), network, run, CHANNELS, OUTPUTS)
    rays = np.array(_turn(cues.rays, quarters, mirror))
    rays[..., :2] = _turn_vectors(rays[..., :2], quarters, mirror)
    maps["normal"] = np.array(frames.from_ray_frame(maps["normal"], rays))
    for name, image in maps.items():
        back = np.rot90(image, -quarters)
        back = back[:, ::-1] if mirror else back
        if name == "normal":
            upright = _turn_vectors(back[..., :2], -quarters, False) * [-1.0 if mirror else 1.0, 1.0]
            back = np.concatenate([upright, back[..., 2:]], axis=-1)
        maps[name] = np.asarray(back, np.float32)
    # zeros outside the object, so that its own pixels alone set the direction at its edge when enlarged
    maps["normal"] = _without_grid(maps["normal"], cues.mask) * cues.mask[..., None]
    return maps


def _without_grid(normal: Floats, mask: Bools) -> Floats:
    """Remove the network's grid artifact, a pattern that repeats every 2 px, from normals (H, W, 3).

    For each of the four places in a 2×2 cell, the deviation that neighboring cells have in common is subtracted. Relief
    does not repeat with the cells, so it remains.
    """
    inside = erode(mask, 1).astype(np.float32)
    out = normal.astype(np.float32)
    uneven = (out - cv2.sepFilter2D(out, -1, BINOMIAL, BINOMIAL)) * inside[..., None]
    for place in (np.s_[y::2, x::2] for y in (0, 1) for x in (0, 1)):
        common, share = (
            cv2.GaussianBlur(np.ascontiguousarray(part[place]), (0, 0), _CELLS) for part in (uneven, inside)
        )
        out[place] -= common / np.maximum(share, LEAST_KNOWN)[..., None] * mask[place][..., None]
    return out


def _median_direction(normals: Floats, errors: Floats) -> Floats:
    """Geometric median direction (H, W, 3) of K normals (K, H, W, 3), weighted by their errors (K, H, W).

    It has the least sum of distances to the normals. Weiszfeld's iteration finds it: a mean weighted by the reciprocal
    distances from the previous mean. Its length is at most 1, and less where the directions differ.
    """
    directions = frames.unit(normals)
    trust = 1 / np.maximum(errors, _LEAST_ERROR)
    weights = trust
    for _ in range(_STEPS):
        mean = (weights[..., None] * directions).sum(axis=0) / weights.sum(axis=0)[..., None]
        difference = directions - frames.unit(mean)
        weights = trust / np.maximum(frames.dot(difference, difference) ** 0.5, _NEAREST)
    return np.asarray(mean, np.float32)


def _turn(image: Floats, quarters: int, mirror: bool) -> Floats:
    """Mirror an image (H, W, …) left to right, then rotate it counter-clockwise by quarter turns."""
    return np.asarray(np.rot90(image[:, ::-1] if mirror else image, quarters))


def _turn_vectors(vector: Floats, quarters: int, mirror: bool) -> Floats:
    """Mirror vectors (..., 2), y up, left to right, then rotate them counter-clockwise by quarter turns."""
    direction = vector[..., 0] + 1j * vector[..., 1]
    turned = 1j**quarters * (-direction.conj() if mirror else direction)
    return np.stack([turned.real, turned.imag], axis=-1)


def _turn_channels(picture: Floats, quarters: int, mirror: bool) -> Floats:
    """Rotate or mirror the directions that the network channels (H, W, N) contain, for a picture turned before."""
    out = np.array(picture)
    for first in ("s1", "zenith_x", "cos_2phi"):  # twice the angle: a quarter negates, a mirror conjugates
        at = CHANNELS.index(first)
        out[..., at : at + 2] *= (-1.0) ** quarters
        out[..., at + 1] *= -1.0 if mirror else 1.0
    at = CHANNELS.index("ray_x")
    out[..., at : at + 2] = _turn_vectors(picture[..., at : at + 2], quarters, mirror)
    return out


def run_network(
    picture: Floats, network: Network, run: RunNetwork, names: tuple[str, ...], outputs: dict[str, int]
) -> dict[str, Floats]:
    """Run a network on channels (N, H, W); returns its maps (H, W[, C]) by name.

    `names` are the names of the channels, which the network must expect. `outputs` gives the number of channels C of
    each map. The picture is padded to the size multiple that the network needs.

    Raises ModelError: the network was made for other channels, or returns other maps.
    """
    if network.channels != names:
        raise ModelError(
            f"model {network.digest[:8]} expects channels {', '.join(network.channels)}; "
            f"this version makes {', '.join(names)}; use a model of this version, or --estimator analytic"
        )
    _, height, width = picture.shape
    multiple = int(network.metadata["size_multiple"])
    pad = ((0, 0), (0, -height % multiple), (0, -width % multiple))
    output = run(network, np.pad(picture, pad)[None].astype(np.float32))
    found = {name: value.shape[1] for name, value in output.items()}
    if any(found.get(name) != count for name, count in outputs.items()):
        raise ModelError(
            f"model {network.digest[:8]} returns {found}; this version needs {outputs}; use a model of this version"
        )
    images = {name: np.moveaxis(output[name][0], 0, -1)[:height, :width] for name in outputs}
    return {name: image[..., 0] if image.shape[-1] == 1 else image for name, image in images.items()}
