"""Test-time augmentation: the network's answer as the mean over symmetries of the square.

A turn or mirror of the picture is one of the scene: polarization turns twice as fast, rays with it.
"""

import numpy as np

from polcap.errors import ModelError
from polcap.images import Cues, Floats, Network
from polcap.optics import frames
from polcap.stages.cues import CHANNELS, channels

_OUTPUTS = {"normal": 3, "depth": 1, "diffuse": 3, "specular": 3, "roughness": 1, "sigma": 1}  # channels of each map
_POSITIONS = tuple(
    (quarters, mirror) for first in (0, 1) for mirror in (False, True) for quarters in (first, first + 2)
)


def mean(cues: Cues, network: Network, symmetries: int) -> dict[str, Floats]:
    """The network's maps (H, W[, 3]) of the whole object, normals in the camera frame, means over several positions.

    A turn or mirror of the picture is one of the scene: polarization turns twice as fast, rays with it.
    """
    picture, rays = np.moveaxis(channels(cues), 0, -1), cues.rays
    total: dict[str, Floats] = {}
    for quarters, mirror in _POSITIONS[:symmetries]:
        turned = _turn(picture, quarters, mirror)
        maps = _run(np.moveaxis(_turn_channels(turned, quarters, mirror), -1, 0), network)
        own = np.array(_turn(rays, quarters, mirror))
        own[..., :2] = _turn_vectors(own[..., :2], quarters, mirror)
        maps["normal"] = np.array(frames.from_ray_frame(maps["normal"], own))
        for name, image in maps.items():
            back = np.rot90(image, -quarters)
            back = back[:, ::-1] if mirror else back
            if name == "normal":
                upright = _turn_vectors(back[..., :2], -quarters, False) * [-1.0 if mirror else 1.0, 1.0]
                back = np.concatenate([upright, back[..., 2:]], axis=-1)
            total[name] = total.get(name, 0) + np.asarray(back, np.float32) / symmetries
    return total


def _turn(image: Floats, quarters: int, mirror: bool) -> Floats:
    """Pixels mirrored left to right, then turned counter-clockwise."""
    return np.asarray(np.rot90(image[:, ::-1] if mirror else image, quarters))


def _turn_vectors(vector: Floats, quarters: int, mirror: bool) -> Floats:
    """Vectors (..., 2), y up, mirrored and turned likewise."""
    x, y = (-vector[..., 0] if mirror else vector[..., 0]), vector[..., 1]
    for _ in range(quarters % 4):
        x, y = -y, x
    return np.stack([x, y], axis=-1)


def _turn_channels(picture: Floats, quarters: int, mirror: bool) -> Floats:
    """Channels (H, W, N) whose pixels were turned, their directions turned too."""
    out = np.array(picture)
    for first in ("s1", "zenith_x", "cos_2phi"):  # twice the angle: a quarter negates, a mirror conjugates
        at = CHANNELS.index(first)
        out[..., at : at + 2] *= (-1.0) ** quarters
        out[..., at + 1] *= -1.0 if mirror else 1.0
    at = CHANNELS.index("ray_x")
    out[..., at : at + 2] = _turn_vectors(picture[..., at : at + 2], quarters, mirror)
    return out


def _run(picture: Floats, network: Network) -> dict[str, Floats]:
    """All maps (H, W[, 3]) of channels (N, H, W)."""
    _, height, width = picture.shape
    multiple = int(network.metadata["size_multiple"])
    pad = ((0, 0), (0, -height % multiple), (0, -width % multiple))
    output = network.run(np.pad(picture, pad)[None].astype(np.float32))
    found = {name: value.shape[1] for name, value in output.items()}
    if any(found.get(name) != count for name, count in _OUTPUTS.items()):
        raise ModelError(
            f"model {network.digest[:8]} makes {found}; this version needs {_OUTPUTS}; use a model of this version"
        )
    images = {name: np.moveaxis(output[name][0], 0, -1)[:height, :width] for name in _OUTPUTS}
    return {name: image[..., 0] if image.shape[-1] == 1 else image for name, image in images.items()}
