"""Error of every map on test meshes under test materials, in the stated conditions."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from polcap.training import gbuffers, materials
from polcap.training.camera import Errors
from polcap.training.dataset import Batch, Light, Simulator


class Watch:
    """A fixed set of held-out pictures that a training run looks at now and then; nothing is chosen by it."""

    def __init__(self, data: Path, folder: Path, device: torch.device, *, count: int = 48, size: int = 128) -> None:
        if not (folder / "index.json").exists():
            meshes = sorted((data / "meshes" / "test").glob("*.npz"))
            gbuffers.build(folder, meshes, views=20, procedural=0, size=size, seed=99)
        held_out = data / "materials" / "test"
        library = materials.Library(held_out if held_out.exists() else None, device, seed=4)
        simulator = Simulator(gbuffers.load(folder), library, device)
        total = len(simulator.views["camera"])
        order = np.random.default_rng(5).permutation(total)[:count]
        with torch.random.fork_rng():
            torch.manual_seed(6)
            self.batches = [test_batch(simulator, order[k : k + 8], size) for k in range(0, len(order), 8)]

    def look(self, network: nn.Module) -> dict[str, float]:
        """Mean figures over all pixels of all pictures."""
        rows = [figures(run(network, batch), batch) for batch in self.batches]
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def test_batch(simulator: Simulator, pick: np.ndarray[Any, np.dtype[Any]], size: int) -> Batch:
    """Those views in the stated conditions, with materials drawn from torch's random state."""
    count, device = len(pick), simulator.device
    view = simulator.look(pick, size, flip=False)
    return simulator.render(view, Light.stated(count, device), Errors.stated(count, device))


def run(network: nn.Module, batch: Batch) -> dict[str, Tensor]:
    device = batch.channels.device
    with torch.no_grad(), torch.autocast(device.type, torch.bfloat16):
        maps: dict[str, Tensor] = network(batch.channels.contiguous(memory_format=torch.channels_last))
    return maps


def angle(maps: dict[str, Tensor], batch: Batch) -> Tensor:
    """Degrees between normals, (B, H, W)."""
    half = (maps["normal"] - batch.normal).norm(dim=1).clamp(max=2) / 2
    return torch.rad2deg(2 * torch.asin(half))


def figures(maps: dict[str, Tensor], batch: Batch) -> dict[str, float]:
    """Errors over the pixels of the mask of one batch."""
    mask = batch.mask
    error = angle(maps, batch)[mask]
    inside = mask[:, None].float()
    area = inside.sum(dim=(2, 3))

    def centred(depth: Tensor) -> Tensor:
        return (depth - ((depth * inside).sum(dim=(2, 3)) / area)[:, :, None, None]) * inside

    low = torch.where(mask[:, None], batch.depth, torch.inf).amin(dim=(2, 3))
    high = torch.where(mask[:, None], batch.depth, -torch.inf).amax(dim=(2, 3))
    depth = ((centred(maps["depth"]) - centred(batch.depth)) / (high - low)[:, :, None, None])[mask[:, None]]
    out = {
        "normal_mean": float(error.mean()),
        "normal_median": float(error.median()),
        "depth_rmse": float(depth.square().mean().sqrt()),
        "sigma_mean": float(maps["sigma"][:, 0][mask].mean()),
    }
    for name in ("diffuse", "specular", "roughness"):
        difference = (maps[name] - getattr(batch, name)).permute(0, 2, 3, 1)[mask]
        spread = getattr(batch, name).permute(0, 2, 3, 1)[mask]
        out[f"{name}_rmse"] = float(difference.square().mean().sqrt())
        out[f"{name}_l1"] = float(difference.abs().mean())
        out[f"{name}_mean_rmse"] = float((spread - spread.mean(dim=0)).square().mean().sqrt())
    return out
