"""Heights from slopes, ambient occlusion of a groove, seamless maps."""

import dataclasses

import cv2
import numpy as np

from polcap.image_values import Floats
from polcap.material import height_map, tiling
from polcap.material.height_map import MaterialMaps

TEXEL = 1e-4


def waves(size: int) -> tuple[Floats, Floats]:
    """Heights (S, S) [m] of a relief, and its slopes to the right and up."""
    x = TEXEL * np.arange(size)
    a, b = 2 * np.pi / (0.2 * size * TEXEL), 2 * np.pi / (0.13 * size * TEXEL)
    height = 1e-4 * (np.sin(a * x)[None] + np.cos(b * x)[:, None])
    right = np.broadcast_to(1e-4 * a * np.cos(a * x)[None], height.shape)
    up = np.broadcast_to(1e-4 * b * np.sin(b * x)[:, None], height.shape)
    return height, np.stack([right, up], axis=-1)


def test_heights_have_the_slopes_and_the_coarse_shape() -> None:
    height, slope = waves(200)
    bowl = 2e-4 * np.linspace(-1, 1, 200)[None] ** 2 + np.zeros((200, 1))
    bowl_slope = np.stack([np.broadcast_to(np.gradient(bowl[0], TEXEL), bowl.shape), 0 * bowl], axis=-1)
    doubt = np.full(height.shape, 0.01)
    wrong = np.zeros_like(slope)
    wrong[::10, ::10], doubt[::10, ::10] = 0.1, 1.0
    found = height_map.integrate(slope + bowl_slope + wrong + 0.001, doubt, bowl, TEXEL)  # with an error common to all
    error = found - height - bowl
    assert (error - error.mean()).std() < 0.05 * np.ptp(height)


def test_slopes_of_a_misplaced_print_are_removed_and_a_groove_that_is_darker_stays() -> None:
    """A chequered print seen 0.02 texels from its place, and mortar one texel deeper than dark bricks."""
    _, relief = waves(200)
    square = (np.arange(200) // 9 % 2).astype(np.float32)
    albedo = cv2.GaussianBlur(np.where(square[:, None] == square, 0.8, 0.1).astype(np.float32), (0, 0), 0.8)
    down, across = np.gradient(np.log(albedo))
    edges = np.stack([across, -down], axis=-1)
    found, _ = height_map.without_print(0.05 * relief + 0.02 * edges, albedo)
    assert (found - 0.05 * relief).std() < 0.3 * (0.02 * edges).std()
    groove, _ = height_map.without_print(relief - edges, albedo)
    assert (groove - relief + edges).std() < 0.03 * edges.std()


def test_a_groove_is_darker_than_the_plane() -> None:
    height = np.zeros((64, 64), np.float32)
    height[:, 30:34] = -4 * TEXEL
    normal = np.broadcast_to(np.array([0, 0, 1], np.float32), (64, 64, 3))
    occlusion = height_map.ambient_occlusion(height, normal, TEXEL)
    assert occlusion[32, 5] > 0.99 and occlusion[32, 31] < 0.7


def maps(size: int = 120) -> MaterialMaps:
    random = np.random.default_rng(0)
    height, slope = waves(size)
    normal = np.concatenate([-slope, np.ones((size, size, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    flat = random.uniform(0.2, 0.8, (size, size)).astype(np.float32)
    color = np.repeat(flat[..., None], 3, axis=-1)
    return MaterialMaps(
        normal.astype(np.float32), color, 0.04 + 0 * color, flat, height.astype(np.float32), np.ones_like(flat),
        flat, flat, flat, flat, seen=np.ones(flat.shape, bool), thickness=0.001,
    )  # fmt: skip


def test_tiled_maps_continue_across_their_edges_and_keep_their_contrast() -> None:
    whole = maps()
    tiled = tiling.tile(whole)
    assert tiled.roughness.shape == (100, 100)
    for value in (tiled.height, tiled.normal[..., 0]):
        inner = np.abs(np.diff(value, axis=1)).max()
        assert np.abs(value[:, 0] - value[:, -1]).max() < 1.5 * inner
    assert abs(tiled.roughness[:, :15].std() / whole.roughness.std() - 1) < 0.1


def test_a_periodic_pattern_is_tiled_in_whole_periods() -> None:
    period = 14
    stripes = np.where(np.arange(120) % period < period / 2, 0.7, 0.3).astype(np.float32)
    color = np.broadcast_to(stripes[:, None, None], (120, 120, 3))
    normal = np.broadcast_to(np.array([0, 0, 1], np.float32), (120, 120, 3))
    whole = dataclasses.replace(maps(), diffuse=color, normal=normal)
    tiled = tiling.tile(whole).diffuse
    assert tiled.shape[0] % period == 0 and tiled.shape[1] == 100
    np.testing.assert_allclose(tiled, color[: len(tiled), :100], atol=0.02)
