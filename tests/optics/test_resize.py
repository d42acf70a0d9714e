"""Area resizing."""

import numpy as np
import pytest

from polcap.optics.resize import area_mean, block_means, weighted_area_mean

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("shape", [(20, 30), (7, 11), (40, 17)])
def test_light_is_conserved(shape: tuple[int, int]) -> None:
    image = RNG.uniform(0, 1, (40, 60, 3)).astype(np.float32)
    small = area_mean(image, shape)
    assert small.shape == (*shape, 3)
    assert small.mean((0, 1)) == pytest.approx(image.mean((0, 1)), rel=1e-5)


def test_mask_becomes_the_share_that_it_covers() -> None:
    mask = np.zeros((6, 6), bool)
    mask[:3, :2] = True
    assert area_mean(mask, (2, 2)) == pytest.approx(np.array([[2 / 3, 0], [0, 0]]))


def test_pixels_without_weight_do_not_count() -> None:
    image = RNG.uniform(0, 1, (12, 12, 3)).astype(np.float32)
    mask = RNG.uniform(size=(12, 12)) < 0.5
    mask[:3, :3] = False
    spoiled = np.where(mask[..., None], image, np.float32(1e3))
    small = weighted_area_mean(spoiled, mask, (4, 4))
    tiles = [(slice(3 * y, 3 * y + 3), slice(3 * x, 3 * x + 3)) for y in range(4) for x in range(4)]
    expected = [image[tile][mask[tile]].mean(0) if mask[tile].any() else np.zeros(3) for tile in tiles]
    assert small.reshape(-1, 3) == pytest.approx(np.array(expected), abs=1e-5)
    assert not small[0, 0].any()


@pytest.mark.parametrize("step", [1, 2, 3])
def test_block_is_the_mean_of_its_pixels(step: int) -> None:
    image = RNG.uniform(0, 1, (13, 17)).astype(np.float32)
    height, width = 13 // step, 17 // step
    blocks = image[: height * step, : width * step].reshape(height, step, width, step).mean((1, 3))
    assert block_means(image, step) == pytest.approx(blocks, rel=1e-5)
