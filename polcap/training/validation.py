"""Errors on held-out pictures while training runs; no choice depends on them."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from polcap.images import Floats
from polcap.report import stage_pictures as pictures
from polcap.report.stage_pictures import Picture
from polcap.stages.cues import FLOOR
from polcap.training import arithmetic, gbuffers, loss, materials, protocol
from polcap.training.camera_errors import Errors
from polcap.training.dataset import Batch, Simulator, batch
from polcap.training.model import COLOR

_FLASH = (0.0, protocol.FLASH)


class HeldOutPictures:
    """Fixed pictures of test meshes with test materials, at the stated camera and flash."""

    def __init__(self, data: Path, folder: Path, device: torch.device, *, count: int = 48, size: int = 128) -> None:
        simulator = held_out(data, folder, device, views=20, size=size)
        total = len(simulator.camera)
        order = np.random.default_rng(5).permutation(total)[:count]
        self.batches = []
        with torch.random.fork_rng():
            torch.manual_seed(6)
            for first in range(0, len(order), 8):
                seen = simulator.look(order[first : first + 8], size, flip=False)
                number = len(seen.mask)
                photo = simulator.shoot(seen, torch.ones(number, device=device), Errors.stated(number, device))
                self.batches.append(batch(photo))

    def errors(self, network: nn.Module) -> dict[str, float]:
        """Mean errors over all pixels of all pictures."""
        rows = [figures(run(network, batch), batch) for batch in self.batches]
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    def picture(self, network: nn.Module) -> Picture:
        """The first batch, a row each: S0, then normal, diffuse, F0, roughness and depth, truth left of estimate."""
        seen = self.batches[0]
        truth = {name: getattr(seen, name) for name in ("normal", "diffuse", "specular", "roughness", "depth")}
        sides = [_drawn(maps, seen.mask) for maps in (truth, run(network, seen))]
        light = (torch.exp(seen.channels[:, COLOR].float()) - FLOOR) * seen.mask[:, None]
        columns = [[pictures.display(s0, 1.0) for s0 in _arrays(light)]]
        columns += [tiles for pair in zip(*sides) for tiles in pair]
        return np.hstack([np.vstack(tiles) for tiles in columns])


def _drawn(maps: dict[str, Tensor], mask: Tensor) -> list[list[Picture]]:
    """Normal (in each ray's frame), diffuse, F0 0…0.3, roughness and depth of every picture."""
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


def held_out(data: Path, folder: Path, device: torch.device, *, views: int, size: int) -> Simulator:
    """Test meshes, test texture sets and a noise volume that training never saw; traced once into `folder`."""
    meshes = sorted((data / "meshes" / "test").glob("*.npz"))
    cache = gbuffers.cached(folder, meshes, gbuffers.Recipe(views, procedural=0, size=size, seed=99, flash=_FLASH))
    textures = data / "materials" / "test"
    library = materials.Library(textures if textures.exists() else None, device, seed=4)
    return Simulator(cache, library, device)


def run(network: nn.Module, batch: Batch) -> dict[str, Tensor]:
    """The maps of a batch, without gradients."""
    device = batch.channels.device
    with torch.no_grad(), arithmetic.fast(device):
        maps: dict[str, Tensor] = network(batch.channels.contiguous(memory_format=torch.channels_last))
    return maps


def figures(maps: dict[str, Tensor], batch: Batch) -> dict[str, float]:
    """Errors over the masked pixels of one batch; `·_constant` is what the best constant map would score."""
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
    """Difference of depths centred within each mask, by the truth's greatest minus least; masked pixels."""
    mask = batch.mask[:, None]
    inside = mask.float()
    low = torch.where(mask, batch.depth, torch.inf).amin(dim=(2, 3), keepdim=True)
    high = torch.where(mask, batch.depth, -torch.inf).amax(dim=(2, 3), keepdim=True)
    return ((loss.centred(depth, inside) - loss.centred(batch.depth, inside)) / (high - low))[mask]
