"""Test-time augmentation: the network's predictions in turned and mirrored positions, averaged.

A picture that is turned by 90° or mirrored shows a scene that is turned or mirrored. Its Stokes vectors (S1, S2) turn
by twice the angle, its rays by the angle itself. Each prediction is transformed back before the average.
"""

from functools import partial

import numpy as np

from polcap import parallel
from polcap.errors import ModelError
from polcap.images import Cues, Floats, Network, RunNetwork
from polcap.optics import frames
from polcap.stages.cues import CHANNELS, channels

OUTPUTS = {"normal": 3, "depth": 1, "diffuse": 3, "specular": 3, "roughness": 1, "sigma": 1}  # channels of each map
_POSITIONS = tuple(
    (quarters, mirror) for first in (0, 1) for mirror in (False, True) for quarters in (first, first + 2)
)
_STEPS = 5  # of the median's iteration
_LEAST_ERROR = 0.5  # degrees
_NEAREST = 0.05  # least distance between unit vectors, about 3°: nearer ones weigh the same


def predict(cues: Cues, network: Network, run: RunNetwork, symmetries: int) -> dict[str, Floats]:
    """The network's maps (H, W[, 3]), averaged over 1, 2, 4 or 8 rotated and mirrored copies of the picture.

    Most maps are means. The normal is the median direction, weighted by the predicted errors: positions often differ by
    half a turn of the azimuth, and the mean of two half-turns is neither. The map `opposed` (H, W) is the share of the
    positions in which the normal leans to the other side of the ray.
    """
    picture = np.moveaxis(channels(cues), 0, -1)
    calls = [
        partial(_predict_turned, picture, cues.rays, network, run, *position) for position in _POSITIONS[:symmetries]
    ]
    predictions = parallel.results(calls, network.at_once)
    maps = {name: np.asarray(np.mean([maps[name] for maps in predictions], axis=0), np.float32) for name in OUTPUTS}
    normals, errors = (np.stack([maps[name] for maps in predictions]) for name in ("normal", "sigma"))
    median = _median_direction(normals, errors)
    towards = median - frames.dot(median, cues.rays)[..., None] * cues.rays
    opposed = np.mean([frames.dot(normal, towards) < 0 for normal in normals], axis=0)
    return maps | {"normal": median, "opposed": opposed.astype(np.float32)}


def _predict_turned(
    picture: Floats, rays: Floats, network: Network, run: RunNetwork, quarters: int, mirror: bool
) -> dict[str, Floats]:
    """Run the network on a rotated or mirrored picture (H, W, N), and transform its maps back."""
    turned = _turn_channels(_turn(picture, quarters, mirror), quarters, mirror)
    maps = run_network(np.moveaxis(turned, -1, 0), network, run, CHANNELS, OUTPUTS)
    own = np.array(_turn(rays, quarters, mirror))
    own[..., :2] = _turn_vectors(own[..., :2], quarters, mirror)
    maps["normal"] = np.array(frames.from_ray_frame(maps["normal"], own))
    for name, image in maps.items():
        back = np.rot90(image, -quarters)
        back = back[:, ::-1] if mirror else back
        if name == "normal":
            upright = _turn_vectors(back[..., :2], -quarters, False) * [-1.0 if mirror else 1.0, 1.0]
            back = np.concatenate([upright, back[..., 2:]], axis=-1)
        maps[name] = np.asarray(back, np.float32)
    return maps


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

    Raises
    ------
    ModelError
        The network was made for other channels, or returns other maps.
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
