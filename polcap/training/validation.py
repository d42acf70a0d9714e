"""Errors of the main network on held-out pictures during training; they do not influence the training."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from polcap.image_values import Floats
from polcap.report import stage_pictures as pictures
from polcap.report.stage_pictures import Picture
from polcap.stages.cues import FLOOR
from polcap.training import evaluation_protocol, loss, main_network, materials, traced_views
from polcap.training.camera_errors import CameraErrors
from polcap.training.progress import Report, silent
from polcap.training.scores import mean_score
from polcap.training.simulator import Batch, Simulator, to_batch

_COUNT, _SIZE = 48, 128  # pictures, px
_RECIPE = traced_views.ViewsRecipe(20, procedural=0, size=_SIZE, seed=99, flash=(0.0, evaluation_protocol.FLASH))


class HeldOutPictures:
    """Fixed pictures of test meshes and test materials, with the camera and flash of the evaluation."""

    def __init__(self, data: Path, folder: Path, device: torch.device, report: Report = silent) -> None:
        cache = traced_views.open_cache(folder, traced_views.test_meshes(data), _RECIPE, report)
        library = materials.MaterialLibrary(data / "materials" / "test", device, seed=4)
        simulator = Simulator(cache, library, device)
        order = np.random.default_rng(5).permutation(len(simulator.camera))[:_COUNT]
        self.batches = []
        with torch.random.fork_rng():
            torch.manual_seed(6)
            for first in range(0, len(order), 8):
                views = simulator.gather(order[first : first + 8], _SIZE, flip=False)
                number = len(views.mask)
                errors = CameraErrors.stated(number, device)
                self.batches.append(to_batch(simulator.photograph(views, torch.ones(number, device=device), errors)))

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def errors(self, network: nn.Module) -> dict[str, float]:
        """Mean errors of a network on the held-out pictures."""
        return mean_score([_errors(main_network.run(network, batch.channels), batch) for batch in self.batches])

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def picture(self, network: nn.Module) -> Picture:
        """Picture of eight held-out cases in rows: S0; truth and estimate of normal, diffuse, F0, roughness, depth."""
        batch = self.batches[0]
        both = [_draw(maps, batch.mask) for maps in (vars(batch), main_network.run(network, batch.channels))]
        light = (torch.exp(batch.channels[:, main_network.COLOR].float()) - FLOOR) * batch.mask[:, None]
        columns = [[pictures.display(s0, 1.0) for s0 in _arrays(light)]]
        columns += [tiles for pair in zip(*both) for tiles in pair]
        return np.hstack([np.vstack(tiles) for tiles in columns])


def _draw(maps: dict[str, Tensor], mask: Tensor) -> list[list[Picture]]:
    """Pictures of the normal (in ray frames), diffuse, F0 from 0 to 0.3, roughness and depth: a list per map."""
    inside = mask.cpu().numpy()
    normal, diffuse, specular, roughness, depth = (
        _arrays(maps[name] * mask[:, None]) for name in ("normal", "diffuse", "specular", "roughness", "depth")
    )
    return [
        [np.asarray(np.rint(127.5 * (n + 1)) * m[..., None], np.uint8) for n, m in zip(normal, inside)],
        [pictures.display(d, 1.0) for d in diffuse],
        [pictures.scale(f.mean(-1), 0, 0.3, m) for f, m in zip(specular, inside)],
        [pictures.scale(r[..., 0], 0, 1, m) for r, m in zip(roughness, inside)],
        [pictures.scale(-d[..., 0], -1.5, 1.5, m) for d, m in zip(depth, inside)],
    ]


def _arrays(images: Tensor) -> Floats:
    """Tensor of images (B, ·, H, W) as an array (B, H, W, ·)."""
    return np.asarray(images.float().permute(0, 2, 3, 1).cpu().numpy())


def _errors(maps: dict[str, Tensor], batch: Batch) -> dict[str, float]:
    """Errors over the masked pixels of one batch; `·_constant` is the error of the best constant map."""
    inside = batch.mask[:, None].float()
    error = loss.normal_error(maps["normal"], batch.normal)[:, 0][batch.mask]
    depth = (loss.centered(maps["depth"], inside) - loss.centered(batch.depth, inside))[:, 0][batch.mask]
    out = {
        "normal_mean": error.mean(), "normal_median": error.median(), "depth_rmse": depth.square().mean().sqrt(),
        "sigma_mean": maps["sigma"][:, 0][batch.mask].mean(),
    }  # fmt: skip
    for name in ("diffuse", "specular", "roughness"):
        truth, estimate = (image.permute(0, 2, 3, 1)[batch.mask] for image in (getattr(batch, name), maps[name]))
        out[f"{name}_rmse"] = (estimate - truth).square().mean().sqrt()
        out[f"{name}_constant"] = (truth - truth.mean(dim=0)).square().mean().sqrt()
    return {name: float(value) for name, value in out.items()}
