"""Training pictures of the refinement network: traced views with added relief, photographed, and the first estimate.

One file per picture, (N + 4, H, W) fp16: the channels of `stages/infer/fine.py`, the true normal in the frame of each
ray (3), the mask of known normals (1).
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
from polcap.training import bounced_light, evaluation_protocol, materials, relief, traced_views
from polcap.training.camera_errors import CameraErrors
from polcap.training.simulator import Indices, SimulatedPhotographs, Simulator

SIDE = 448  # px
_FIRST_SIZES = (80, 400)  # px of the longer side at which the main network sees a picture
_IOR = 1.5
_SHIFT = 2.5  # factor on the misregistration of the main network's training, which has larger pixels
RECIPE = traced_views.ViewsRecipe(views=2, procedural=14, size=SIDE, seed=51, per_shape=4)


class SimulatorWithoutBounces(Simulator):
    """Light from the flash alone, because the cache can index bounces only up to 256² pixels.

    Bounced light varies more slowly than relief. It is missing only in shadows next to an outline (decision 29).
    """

    def _seen_pixels(
        self, view: Indices, y: Indices, x: Indices, order: Indices, mask: Any, owner: Indices
    ) -> tuple[Indices, NDArray[np.float32]]:
        return np.full((len(owner), bounced_light.RAYS), -1), np.zeros(len(owner), np.float32)


@dataclass(frozen=True)
class FinePictureMaker:
    """Views and materials, and the main network."""

    simulator: Simulator
    network: Network

    @staticmethod
    def open(views: Path, data: Path, network: Network) -> "FinePictureMaker":
        """Trace the views of the training meshes if the folder `views` lacks them."""
        meshes, device = traced_views.training_meshes(data), torch.device("cpu")
        library = materials.MaterialLibrary(data / "materials" / "train", device)
        cache = traced_views.open_cache(views, meshes, RECIPE)
        return FinePictureMaker(SimulatorWithoutBounces(cache, library, device), network)

    def picture(self, number: int) -> NDArray[np.float16]:
        """Channels, true normal and mask of known normals (N + 4, H, W), cropped to the object."""
        rng = np.random.default_rng([RECIPE.seed, number])
        focal, x, y, middle = self.simulator.camera[number % len(self.simulator.camera)][:4]
        with torch.random.fork_rng():
            torch.manual_seed(number)
            photo = self._photograph(number, float(middle / focal), rng)
        mask = photo.input_mask[0].numpy()
        view = View(focal=float(focal), center=(float(x), float(y)), scale=1.0)
        measured = (photo.stokes, photo.covariance, photo.clipped)
        image = evaluation_protocol.stokes_image(measured, photo.at.numpy(), mask, view)
        estimated = cues.compute(image, evaluation_protocol.white())
        size = int(_FIRST_SIZES[0] * (_FIRST_SIZES[1] / _FIRST_SIZES[0]) ** rng.random())
        network = replace(self.network, metadata={**self.network.metadata, "native_size": str(size)})
        _, guess, _ = learned.estimate_coarse(estimated, network, onnx.run, _IOR, 1)
        truth = np.moveaxis(photo.truth["normal"][0].numpy(), -1, 0)
        known = (photo.mask[0].numpy() & mask)[None]
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        crop = np.s_[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        layers: Floats = np.concatenate([fine.encode(estimated, guess), truth, known])
        return np.ascontiguousarray(layers[crop].astype(np.float16))

    def _photograph(self, number: int, px: float, rng: np.random.Generator) -> SimulatedPhotographs:
        """Photographs of a view with random relief; px is the length that a pixel shows."""
        views = self.simulator.gather(np.array([number % len(self.simulator.camera)]), SIDE, flip=False)
        pixels = views.pixels
        slope = relief.random_slopes(pixels.position.numpy(), px, rng) @ views.turn[0].numpy().T
        normal = torch.from_numpy(relief.tilt_normals(pixels.normal.numpy(), slope))
        errors = CameraErrors.draw(1, normal.device)
        errors = replace(errors, shift=_SHIFT * errors.shift)
        return self.simulator.photograph(replace(views, pixels=replace(pixels, normal=normal)), torch.ones(1), errors)


def make_pictures(folder: Path, maker: FinePictureMaker, count: int) -> None:
    """Make those of `count` pictures that the folder lacks."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        path = folder / f"{number:05d}.npy"
        if not path.exists():
            with atomic.path(path) as temporary, temporary.open("wb") as file:
                np.save(file, maker.picture(number))
