"""The main network: pictures of any size, outputs in their ranges, gradients for all weights."""

import pytest
import torch

from polcap.stages.cues import CHANNELS
from polcap.training import main_network
from polcap.training.variants import VARIANTS

TINY = main_network.NetworkShape((8, 16, 16, 16, 16), (8, 8, 16, 16), (8, 8, 8, 8), (8, 8, 8, 8), (1, 1, 1, 1, 1), 1)


def inputs(height: int, width: int) -> torch.Tensor:
    torch.manual_seed(0)
    x = torch.randn(2, len(CHANNELS), height, width)
    x[:, CHANNELS.index("mask")] = 1
    x[:, CHANNELS.index("clipped")] = (x[:, CHANNELS.index("clipped")] > 2).float()
    return x


@pytest.mark.parametrize("size", [(32, 32), (64, 160), (96, 32)])
def test_any_multiple_of_32_gives_every_map_its_range(size: tuple[int, int]) -> None:
    maps = main_network.MainNetwork(TINY)(inputs(*size))
    assert set(maps) == {*main_network.OUTPUTS, "highlight"}
    for name, count in {"normal": 3, "depth": 1, "diffuse": 3, "specular": 3, "roughness": 1, "sigma": 1}.items():
        assert maps[name].shape == (2, count, *size) and maps[name].isfinite().all()
    torch.testing.assert_close(maps["normal"].norm(dim=1), torch.ones(2, *size))
    assert maps["sigma"].min() > 0 and maps["sigma"].max() < 60


def test_every_weight_gets_a_gradient_after_a_few_steps() -> None:
    torch.manual_seed(1)
    network = main_network.MainNetwork(TINY)
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    for _ in range(3):
        optimizer.zero_grad()
        maps = network(inputs(64, 64))
        sum(((m - 0.3) ** 2).mean() for m in maps.values()).backward()
        optimizer.step()
    still = [name for name, p in network.named_parameters() if p.grad is None or float(p.grad.abs().sum()) == 0]
    assert not still


def test_attention_connects_all_cells_of_the_object() -> None:
    torch.manual_seed(6)
    context = main_network.Context(16, heads=2)
    torch.nn.init.normal_(context.proj.weight)
    x, inside = torch.randn(1, 16, 4, 4), torch.ones(1, 1, 4, 4)
    inside[..., 3] = 0
    before = context(x, inside)
    for column, seen in ((0, True), (3, False)):  # on the object, outside it
        changed = x.clone()
        changed[..., 0, column] += 1
        moved = (context(changed, inside) - before)[..., 3, 1].abs().max()
        assert (moved > 1e-2) if seen else (moved < 1e-2)


def test_groups_depend_on_features_not_on_position() -> None:
    """The output of `LinearAttention` at a pixel depends on the features of all pixels, not on its position."""
    torch.manual_seed(3)
    share = main_network.LinearAttention(16, heads=2, groups=4)
    torch.nn.init.normal_(share.proj.weight)
    x, inside = torch.randn(1, 16, 6, 6), torch.ones(1, 1, 6, 6)
    order = torch.randperm(36)
    mixed = x.flatten(2)[:, :, order].reshape(x.shape)
    expected = share(x, inside).flatten(2)[:, :, order].reshape(x.shape)
    torch.testing.assert_close(share(mixed, inside), expected, rtol=1e-4, atol=1e-5)
    assert (share(x, inside) - x).abs().max() > 1e-3


@pytest.mark.parametrize("name", [name for name, v in VARIANTS.items() if v.inputs is not VARIANTS["ours"].inputs])
def test_variants_see_no_more_than_their_inputs(name: str) -> None:
    """Channels that a variant does not use have no effect on its output."""
    torch.manual_seed(5)
    x = inputs(32, 32)
    changed = x.clone()
    blind = ["noise", "zenith_x"] if name == "published inputs" else ["s1", "s2", "zenith_x", "cos_2phi", "noise"]
    for channel in blind:
        changed[:, CHANNELS.index(channel)] += 1
    network = main_network.MainNetwork(TINY, name)
    for a, b in zip(network(x).values(), network(changed).values()):
        torch.testing.assert_close(a, b)


def test_published_inputs_obey_malus_law() -> None:
    """The sum of the pictures at 0° and 90° is S0, their difference S1."""
    x = inputs(32, 32)
    at = {name: x[:, CHANNELS.index(name)] for name in CHANNELS}
    seen = VARIANTS["published inputs"].inputs(x)
    s0 = torch.exp(at["log_g"]) - 0.02
    torch.testing.assert_close(seen[:, 1] + seen[:, 7], s0)
    torch.testing.assert_close(seen[:, 1] - seen[:, 7], s0 * at["s1"] / 10)
    assert seen.shape == x.shape
