"""Errors on held-out pictures during training; nothing is chosen by them."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from polcap.images import Floats
from polcap.report import stage_pictures as pictures
from polcap.report.stage_pictures import Picture
from polcap.stages.cues import FLOOR
from polcap.training import evaluation_protocol, loss, materials, precision, traced_views
from polcap.training.camera_errors import CameraErrors
from polcap.training.main_network import COLOR
from polcap.training.simulator import Batch, Simulator, to_batch

_FLASH = (0.0, evaluation_protocol.FLASH)


class HeldOutPictures:
    """Fixed pictures of test meshes and test materials, with the camera and flash of the evaluation."""

    def __init__(self, data: Path, folder: Path, device: torch.device, *, count: int = 48, size: int = 128) -> None:
        simulator = open_simulator(data, folder, device, views=20, size=size)
        total = len(simulator.camera)
        order = np.random.default_rng(5).permutation(total)[:count]
        self.batches = []
        with torch.random.fork_rng():
            torch.manual_seed(6)
            for first in range(0, len(order), 8):
                views = simulator.gather(order[first : first + 8], size, flip=False)
                number = len(views.mask)
                photo = simulator.photograph(
                    views, torch.ones(number, device=device), CameraErrors.stated(number, device)
                )
                self.batches.append(to_batch(photo))

    def errors(self, network: nn.Module) -> dict[str, float]:
        """Mean errors over all pixels of all pictures."""
        rows = [figures(run(network, batch), batch) for batch in self.batches]
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    def picture(self, network: nn.Module) -> Picture:
        """First batch, one row per picture: S0, then truth and estimate of normal, diffuse, F0, roughness, depth."""
        batch = self.batches[0]
        truth = {name: getattr(batch, name) for name in ("normal", "diffuse", "specular", "roughness", "depth")}
        sides = [_display(maps, batch.mask) for maps in (truth, run(network, batch))]
        light = (torch.exp(batch.channels[:, COLOR].float()) - FLOOR) * batch.mask[:, None]
        columns = [[pictures.display(s0, 1.0) for s0 in _arrays(light)]]
        columns += [tiles for pair in zip(*sides) for tiles in pair]
        return np.hstack([np.vstack(tiles) for tiles in columns])


def _display(maps: dict[str, Tensor], mask: Tensor) -> list[list[Picture]]:
    """Images of normal (in each ray's frame), diffuse, F0 0…0.3, roughness and depth of all pictures."""
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
    """(B, ·, H, W) -> (B, H, W, ·)."""
    return np.asarray(images.float().permute(0, 2, 3, 1).cpu().numpy())


def open_simulator(data: Path, folder: Path, device: torch.device, *, views: int, size: int) -> Simulator:
    """Simulator of test meshes with test materials, unknown to training; traced once into `folder`."""
    meshes = sorted((data / "meshes" / "test").glob("*.npz"))
    cache = traced_views.open_cache(
        folder, meshes, traced_views.ViewsRecipe(views, procedural=0, size=size, seed=99, flash=_FLASH)
    )
    library = materials.MaterialLibrary(data / "materials" / "test", device, seed=4)
    return Simulator(cache, library, device)


def run(network: nn.Module, batch: Batch) -> dict[str, Tensor]:
    """Estimated maps of a batch, without gradients."""
    device = batch.channels.device
    with torch.no_grad(), precision.autocast(device):
        maps: dict[str, Tensor] = network(batch.channels.contiguous(memory_format=torch.channels_last))
    return maps


def figures(maps: dict[str, Tensor], batch: Batch) -> dict[str, float]:
    """Errors over the masked pixels of one batch; `·_constant` is the error of the best constant map."""
    mask = batch.mask
    half = (maps["normal"] - batch.normal).norm(dim=1).clamp(max=2) / 2
    error = torch.rad2deg(2 * torch.asin(half))[mask]
    out = {
        "normal_mean": float(error.mean()),
        "normal_median": float(error.median()),
        "depth_rmse": float(_depth_error(maps["depth"], batch).square().mean().sqrt()),
        "sigma_mean": float(maps["sigma"][:, 0][mask].mean()),
    }
    for name in ("diffuse", "specular", "roughness"):
        truth = getattr(batch, name).permute(0, 2, 3, 1)[mask]
        difference = maps[name].permute(0, 2, 3, 1)[mask] - truth
        out[f"{name}_rmse"] = float(difference.square().mean().sqrt())
        out[f"{name}_l1"] = float(difference.abs().mean())
        out[f"{name}_constant"] = float((truth - truth.mean(dim=0)).square().mean().sqrt())
    return out


def _depth_error(depth: Tensor, batch: Batch) -> Tensor:
    """Error of relative depth at the masked pixels (M,), in units of the truth's range; both centered in the mask."""
    mask = batch.mask[:, None]
    inside = mask.float()
    low = torch.where(mask, batch.depth, torch.inf).amin(dim=(2, 3), keepdim=True)
    high = torch.where(mask, batch.depth, -torch.inf).amax(dim=(2, 3), keepdim=True)
    return ((loss.centered(depth, inside) - loss.centered(batch.depth, inside)) / (high - low))[mask]
