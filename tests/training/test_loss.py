"""The loss is 0 at the truth; that of the expected error is least at the actual error."""

import pytest
import torch
from torch import Tensor

from polcap.training import loss
from polcap.training.simulator import Batch, Simulator


@pytest.fixture(scope="module")
def batch(simulator: Simulator) -> Batch:
    torch.manual_seed(0)
    return simulator.draw_batch(3, 64)


def maps_of(batch: Batch, sigma: float = 10.0) -> dict[str, Tensor]:
    names = ("normal", "depth", "diffuse", "specular", "roughness", "highlight")
    return {n: getattr(batch, n).clone() for n in names} | {"sigma": torch.full_like(batch.depth, sigma)}


def parts(maps: dict[str, Tensor], batch: Batch) -> dict[str, float]:
    return loss.total(maps, batch, torch.Generator().manual_seed(0))[1]


def test_loss_of_the_truth_is_zero(batch: Batch) -> None:
    cost = parts(maps_of(batch), batch)
    for name in ("normal", "depth", "diffuse", "specular", "roughness", "highlight", "render", "degrees"):
        assert cost[name] == pytest.approx(0, abs=1e-4 if name != "degrees" else 0.05), name


@pytest.mark.parametrize("name", ["normal", "diffuse", "specular", "roughness"])
def test_rendering_loss_depends_on_every_map(batch: Batch, name: str) -> None:
    maps = maps_of(batch)
    maps[name] = (maps[name] * 0.7 + 0.05).contiguous()
    maps["normal"] = torch.nn.functional.normalize(maps["normal"], dim=1)
    assert parts(maps, batch)["render"] > 1e-4


def test_a_shift_of_all_depths_has_no_loss(batch: Batch) -> None:
    maps = maps_of(batch)
    maps["depth"] = maps["depth"] + torch.tensor([3.0, -1.0, 0.5]).view(3, 1, 1, 1)
    assert parts(maps, batch)["depth"] == pytest.approx(0, abs=1e-4)


def test_expected_error_is_least_at_the_actual_one(batch: Batch) -> None:
    maps = maps_of(batch)
    tilt = torch.tensor([[1.0, 0, 0], [0, 0.9781476, -0.2079117], [0, 0.2079117, 0.9781476]])  # 12° about x
    maps["normal"] = torch.einsum("ij,bjhw->bihw", tilt, maps["normal"])
    moved = parts(maps, batch)["degrees"]
    cost = {}
    for sigma in (moved / 1.3, moved, moved * 1.3):
        maps["sigma"] = torch.full_like(batch.depth, sigma)
        cost[sigma] = parts(maps, batch)["sigma"]
    assert min(cost, key=cost.__getitem__) == moved and 1 < moved <= 12.01


def test_gradients_are_finite_at_the_truth_and_far_from_it(batch: Batch) -> None:
    for scale in (0.0, 1.0):
        torch.manual_seed(4)
        maps = {name: (m + scale * torch.randn_like(m)).requires_grad_() for name, m in maps_of(batch).items()}
        used = maps | {
            "normal": torch.nn.functional.normalize(maps["normal"], dim=1),
            "roughness": maps["roughness"].clamp(0, 1), "sigma": maps["sigma"].clamp(min=1),
        }  # fmt: skip
        loss.total(used, batch, None)[0].backward()
        assert all(m.grad is not None and m.grad.isfinite().all() for m in maps.values())


def test_a_region_turned_about_the_ray_costs_more_than_as_many_scattered_pixels(batch: Batch) -> None:
    half = torch.tensor([-1.0, -1.0, 1.0]).view(1, 3, 1, 1)
    size = batch.mask.shape[-1]
    block = torch.zeros(size, size)
    block[:, : size // 2] = 1
    order = torch.randperm(size * size, generator=torch.Generator().manual_seed(1))
    scattered = block.flatten()[order].view(size, size)
    cost = {}
    for name, where in (("block", block), ("scattered", scattered)):
        maps = maps_of(batch)
        maps["normal"] = torch.where(where.bool(), half * maps["normal"], maps["normal"])
        cost[name] = parts(maps, batch)
    assert cost["block"]["region"] > 1.5 * cost["scattered"]["region"] > 0
    assert cost["block"]["normal"] < 1.5 * cost["scattered"]["normal"]
