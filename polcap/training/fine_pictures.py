"""Pictures for the fine pass: traced views in relief, photographed, and what the shipped network says of them.

One file a picture: the channels of `stages/infer/fine.py`, then the true normal in the frame of each ray, then
where it is known; (N + 4, H, W) in halves.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from polcap.formats import atomic, onnx
from polcap.images import Floats, Network, View
from polcap.stages import cues
from polcap.stages.infer import fine, learned
from polcap.training import bounce, gbuffers, materials, protocol, relief
from polcap.training.camera_errors import Errors
from polcap.training.dataset import Indices, Simulator

SIDE = 448  # px
_SHOWN = (80, 400)  # px of the longer side that the first network is shown
_IOR = 1.5
_MOVED = 2.5  # times the misregistration of the first network's training, which counts in larger pixels
RECIPE = gbuffers.Recipe(views=2, procedural=14, size=SIDE, seed=51, per_shape=4)


class WithoutBounces(Simulator):
    """Light from the lamp alone: the cache's indices end at 256² pixels.

    What bounces is coarser than relief, but in shadows beside a limb, which nothing else lights (decision 29).
    """

    def _met(
        self, first: Indices, y: Indices, x: Indices, order: Indices, mask: Any, owner: Indices
    ) -> tuple[Indices, NDArray[np.float32]]:
        return np.full((len(owner), bounce.RAYS), -1), np.zeros(len(owner), np.float32)


@dataclass(frozen=True)
class Studio:
    """Views, materials and the first network."""

    simulator: Simulator
    network: Network

    @staticmethod
    def open(views: Path, data: Path, network: Network) -> "Studio":
        """Trace what is missing of the views of the training meshes."""
        meshes = gbuffers.training_meshes(data)
        library = materials.Library(data / "materials" / "train", torch.device("cpu"))
        simulator = WithoutBounces(gbuffers.cached(views, meshes, RECIPE), library, torch.device("cpu"))
        return Studio(simulator, network)

    def picture(self, number: int) -> NDArray[np.float16]:
        """Channels, true normal, and where it is known; the object's crop."""
        rng = np.random.default_rng([RECIPE.seed, number])
        with torch.random.fork_rng():
            torch.manual_seed(number)
            seen = self.simulator.look(np.array([number % len(self.simulator.camera)]), SIDE, flip=False)
            focal, x, y, middle = self.simulator.camera[number % len(self.simulator.camera)][:4]
            slope = relief.slopes(seen.position.numpy(), float(middle / focal), rng) @ seen.turn[0].numpy().T
            normal = torch.from_numpy(relief.bent(seen.normal.numpy(), slope))
            seen = replace(seen, normal=normal)
            errors = Errors.draw(1, normal.device)
            errors = replace(errors, shift=_MOVED * errors.shift)
            photo = self.simulator.shoot(seen, torch.ones(1), errors)
        mask = photo.given[0].numpy()
        view = View(focal=float(focal), center=(float(x), float(y)), scale=1.0)
        measured = (photo.stokes, photo.covariance, photo.clipped)
        image = protocol.stokes_image(measured, photo.at.numpy(), mask, view)
        found = cues.compute(image, protocol.white())
        shown = int(_SHOWN[0] * (_SHOWN[1] / _SHOWN[0]) ** rng.random())
        first = replace(self.network, metadata={**self.network.metadata, "native_size": str(shown)})
        _, guess, _ = learned.known(found, first, onnx.run, _IOR, 1)
        truth = np.moveaxis(photo.truth["normal"][0].numpy(), -1, 0)
        known = (photo.mask[0].numpy() & mask)[None]
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        crop = np.s_[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        both: Floats = np.concatenate([fine.encode(found, guess), truth, known])
        return np.ascontiguousarray(both[crop].astype(np.float16))


def main(folder: Path, studio: Studio, count: int) -> None:
    """Make the pictures that are missing of `count`."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = folder / f"{number:05d}.npy"
        if not path.exists():
            with atomic.path(path) as beside, beside.open("wb") as file:
                np.save(file, studio.picture(number))
