"""Simulated pictures for training the mask network: traced views with materials, light, a chart and camera errors.

Cases in which objects are hard to find are drawn often: black gloss on black cloth, white on white, an object in the
backdrop's color, deep shadow, printed backdrops, a chart that touches the object. Backdrops polarize too: cloth and
paper a little, tables by their gloss.
"""

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polcap.formats import shipped_data
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.optics.body import SMOOTH
from polcap.stages.mask.mask_channels import ReducedPicture, grid
from polcap.training import backdrop_patterns, materials, random_shapes
from polcap.training.mask_views import MaskView, meet_planes
from polcap.training.materials import Surface

Mode = Literal["any", "dark", "black", "white", "alike", "shadow", "printed", "pictured"]
MODES: dict[Mode, float] = {
    "any": 0.2, "dark": 0.12, "black": 0.1, "white": 0.08, "alike": 0.12, "shadow": 0.11, "printed": 0.12,
    "pictured": 0.15,
}  # fmt: skip
_PITCH = 16  # px per patch in the picture of the chart
_UNDETECTED = 1 / 14  # share of the charts in the picture


@dataclass(frozen=True)
class MaskScene:
    """Noise-free picture for training the mask network, with the true mask and the chart."""

    stokes: Floats  # (3, H, W, 3) S0, S1, S2 in linear Rec.709
    chart: Bools  # (H, W) the chart, where it is found
    corners: Floats | None  # (4, 2) px, of the outer patches, dark skin first; None: not found
    mask: Bools  # (H, W)


def make_scene(
    view: MaskView, library: materials.MaterialLibrary, mode: Mode, rng: np.random.Generator, charted: float = 0.75,
    touching: float = 0.4,
) -> MaskScene:  # fmt: skip
    """Draw materials and light for a traced view, from `rng` and from torch's global random state.

    charted, touching: probability of a chart, and that it is placed as near to the object as possible.
    """
    mask = view.object.mask
    size = mask.shape
    v = frames.rays(view.object.view, *size).reshape(-1, 3)
    to_plane, plane_normal, plane = meet_planes(view.planes, v)
    at = np.flatnonzero(mask.reshape(-1) | np.isfinite(to_plane))  # pixels of the object or of the backdrop
    on_object, v = mask.reshape(-1)[at], v[at]
    traced = view.object
    depth, normal, position = (
        image.reshape(len(to_plane), -1)[at] for image in (traced.depth, traced.normal, traced.position)
    )
    place = -v * np.where(on_object, depth[:, 0] / v[:, 2], to_plane[at])[:, None]  # camera frame
    normal = np.where(on_object[:, None], normal, plane_normal[at])
    position = np.where(on_object[:, None], position, place)
    owner = torch.from_numpy(np.where(on_object, 0, 1))
    turn = torch.stack([torch.from_numpy(view.turn).float(), torch.eye(3)])
    normals, positions = (torch.from_numpy(a).float() for a in (normal, position))
    surface = materials.draw_surface(library, normals, positions, turn, owner)
    surface, polarizing = _change_materials(surface, position, np.where(on_object, -1, plane[at]), mode, rng)
    lit = cv2.GaussianBlur(view.lit.astype(np.float32), (0, 0), rng.uniform(0.4, 2.5))  # the flash has a size
    strength = lit.reshape(-1)[at] * view.distance**2
    image = np.zeros((3, *size, 3), np.float32)
    image.reshape(3, -1, 3)[:, at] = _light(surface, v, view.flash - place, strength, polarizing, rng)
    image[0] += 1e-4 * rng.uniform(0, 1, 3)  # stray light
    chart, corners = np.zeros(size, bool), None
    if rng.random() < charted:
        chart, corners = _add_chart(image, mask, touching, rng)
    sigma = rng.uniform(0.35, 0.9)
    blurred = np.stack([cv2.GaussianBlur(one, (0, 0), sigma) for one in image])
    return MaskScene(blurred, chart, corners, mask)


def simulate_measurement(color: Floats, sums: Floats, chart: Bools, rng: np.random.Generator) -> ReducedPicture:
    """Add noise, and errors of gain and alignment, to a simulated picture.

    `color` is S0 (H, W, 3), `sums` are the Stokes parameters summed over colors (3, H, W), `chart` (H, W) is the chart.
    """
    bright = float(np.percentile(color.mean(-1), 98)) + 1e-9
    color, sums = color / bright, sums / bright
    noise = random_shapes.log_uniform(3e-4, 6e-3, rng)
    spread = noise * np.hypot(np.sqrt(np.maximum(color, 0)), rng.uniform(0.02, 0.2))
    color = color + spread * rng.standard_normal(spread.shape, np.float32)
    total = spread.sum(-1) / np.sqrt(3)
    slope = np.gradient(sums[0])
    seen = [color.sum(-1)]
    for k in (1, 2):
        off = rng.normal(0, 0.008) * sums[0] + sum(rng.normal(0, 0.08) * s for s in slope)
        seen.append(sums[k] + off + 1.5 * total * rng.standard_normal(total.shape, np.float32))
    tint = np.exp(rng.normal(0, 0.04, 3))
    stokes = np.stack(seen).astype(np.float32)
    return ReducedPicture((color * tint).astype(np.float32), stokes, chart, grid(*chart.shape))


def _change_materials(
    surface: Surface, position: Floats, number: NDArray[np.intp], mode: Mode, rng: np.random.Generator
) -> tuple[Surface, Tensor]:
    """Change materials to a difficult case `mode`; also returns a factor on each pixel's polarization (M,).

    `number` (M,) is −1 for the object, 0 for the plane below or behind it, 1 for the wall behind that plane.
    """
    diffuse, rough, specular = surface.diffuse.numpy(), surface.roughness.numpy(), surface.specular.numpy()
    factor = np.full(len(diffuse), rng.uniform(0.35, 1.0), np.float32)
    object_ = number < 0
    if mode == "black":
        _recolor(diffuse, object_, random_shapes.log_uniform(0.003, 0.05, rng), rng.uniform(0, 0.6), rng)
        rough[object_] = np.clip(0.3 * rough[object_] + rng.uniform(0.05, 0.35), 0.08, 1)
        specular[object_] = rng.uniform(0.03, 0.06)
    elif mode == "white":
        _recolor(diffuse, object_, rng.uniform(0.55, 0.9), rng.uniform(0, 0.2), rng)
    elif mode == "shadow" or rng.random() < 0.1:
        _recolor(diffuse, object_, diffuse[object_].mean() * rng.uniform(0.2, 1.0), rng.uniform(0.3, 1), rng)
    for plane in np.unique(number[number >= 0]):
        on_plane = number == plane
        gloss = mode not in ("dark", "black") and rng.random() < 0.3
        if mode in ("dark", "black", "shadow"):
            level = random_shapes.log_uniform(0.004, 0.06, rng)
            _recolor(diffuse, on_plane, level, rng.choice([0.0, rng.uniform(0, 0.6)]), rng)
        elif mode == "white":
            _recolor(diffuse, on_plane, rng.uniform(0.45, 0.92), rng.choice([0.0, rng.uniform(0, 0.2)]), rng)
        elif mode == "alike":
            mean = diffuse[object_].mean(axis=0) * rng.uniform(0.6, 1.5)
            share = rng.uniform(0, 0.8)
            diffuse[on_plane] = mean * (1 - share + share * diffuse[on_plane] / max(diffuse[on_plane].mean(), 1e-3))
        elif mode == "printed":
            diffuse[on_plane] = backdrop_patterns.draw_print(position[on_plane], rng)
        elif mode == "pictured":
            diffuse[on_plane] = backdrop_patterns.draw_pattern(position[on_plane], rng)
        elif rng.random() < 0.5:  # plain paper, cloth or board
            _recolor(diffuse, on_plane, random_shapes.log_uniform(0.02, 0.9, rng), rng.uniform(0, 0.3), rng)
        specular[on_plane] = rng.uniform(0.03, 0.05) if gloss else rng.uniform(0.0, 0.02)
        rough[on_plane] = rng.uniform(0.15, 0.6) if gloss else rng.uniform(0.6, 1.0)
        factor[on_plane] = rng.uniform(0.4, 1.0) if gloss else rng.uniform(0.0, 0.35)
    diffuse, specular, rough, factor = (
        torch.from_numpy(a) for a in (np.clip(diffuse, 0.0, 0.97), np.clip(specular, 0.0, 0.97), rough, factor)
    )
    return replace(surface, diffuse=diffuse, specular=specular, roughness=rough, law=SMOOTH), factor


def _recolor(diffuse: Floats, where: Bools, level: float, contrast: float, rng: np.random.Generator) -> None:
    """Change the albedo of part of a picture, in place: to a mean of `level` and a contrast of the pattern.

    The new color is nearly gray in half of the cases.
    """
    pattern = diffuse[where] / max(diffuse[where].mean(), 1e-3)
    hue = np.exp(rng.normal(0, rng.choice([0.03, 0.3]), 3))
    diffuse[where] = np.clip(level * hue * (1 - contrast + contrast * pattern), 0.002, 0.95)


def _light(
    surface: Surface, v: Floats, to_flash: Floats, strength: Floats, polarizing: Tensor, rng: np.random.Generator
) -> Floats:
    """Stokes parameters (3, M, 3) of a surface under the flash and weak light from the walls of the room.

    v (M, 3) are view rays; to_flash (M, 3) and strength (M,) are as for `materials.reflect`; polarizing (M,) is a
    factor on S1 and S2.
    """
    ray, light = (torch.from_numpy(a).float() for a in (v, to_flash))
    normal, diffuse, specular = materials.reflect(surface, ray, light, torch.from_numpy(strength))
    stokes = diffuse + specular
    stokes[1:] *= polarizing[None, :, None]
    stokes[0] += random_shapes.log_uniform(5e-4, 0.08, rng) * surface.diffuse * (0.4 + 0.6 * normal[:, 2:])
    return np.asarray(stokes.numpy(), dtype=np.float32)


def _add_chart(image: Floats, mask: Bools, touching: float, rng: np.random.Generator) -> tuple[Bools, Floats | None]:
    """Paint a ColorChecker next to or behind the object into the Stokes parameters (3, H, W, 3) of a picture.

    Returns its detected area (H, W) and corners (4, 2): no area and None where it has no place or is not detected.
    """
    height, width = mask.shape
    frame = rng.uniform(0.15, 0.5)  # its width, in patches
    picture, aspect = _chart_picture(frame), (4 + 2 * frame) / (6 + 2 * frame)  # 4 rows of 6 patches
    quad = _place_chart(mask, aspect, rng.random() < touching, rng)
    if quad is None:
        return np.zeros(mask.shape, bool), None
    tall, wide = picture.shape[:2]
    source = np.array([[0, 0], [wide, 0], [wide, tall], [0, tall]], np.float32) - 0.5
    matrix = cv2.getPerspectiveTransform(source, quad.astype(np.float32))
    color = cv2.warpPerspective(picture, matrix, (width, height), flags=cv2.INTER_AREA)
    cover = cv2.warpPerspective(np.ones((tall, wide), np.float32), matrix, (width, height)) * ~mask
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    light = rng.uniform(0.6, 1.4) * (1 + rng.normal(0, 0.08) * x + rng.normal(0, 0.08) * y)
    sheen = rng.uniform(0, 0.01)
    image[0] += cover[..., None] * (light[..., None] * (color + sheen) - image[0])
    image[1:] *= 1 - cover[..., None]  # the chart does not polarize
    inner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * frame * _PITCH + source  # outer corners of the patches
    corners = cv2.perspectiveTransform(inner[None].astype(np.float32), matrix)[0]
    corners += rng.normal(0, 0.004 * max(height, width), (4, 2)) * (rng.random() < 0.3)  # error of the detection
    if rng.random() < _UNDETECTED:
        return np.zeros(mask.shape, bool), None
    return _fill(corners, mask.shape), corners


def _place_chart(mask: Bools, aspect: float, near: bool, rng: np.random.Generator) -> Floats | None:
    """Corners (4, 2) of a free place for the chart, `near` the object or anywhere; `aspect`: height over width."""
    size = np.array(mask.shape[::-1])
    found: list[tuple[float, Floats]] = []
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    for _ in range(14):  # random tries
        across = size.max() * rng.uniform(0.14, 0.36)
        turn = rng.normal(0, 0.08) + rng.choice([0, np.pi / 2, -np.pi / 2, np.pi], p=[0.7, 0.12, 0.12, 0.06])
        half = np.array([[-1, -aspect], [1, -aspect], [1, aspect], [-1, aspect]]) * across / 2
        quad = half @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        quad *= 1 + rng.normal(0, 0.02, (4, 2))
        quad += rng.uniform(0, 1, 2) * size
        zone = _fill(quad, mask.shape)
        if (quad < 0).any() or (quad >= size).any() or not zone.any():
            continue
        if mask[zone].mean() <= (0.06 if near else 0.0):
            found.append((float(distance[zone].min()) if near else rng.uniform(), quad))
    return min(found, key=lambda place: place[0])[1] if found else None


def _fill(quad: Floats, shape: tuple[int, ...]) -> Bools:
    """Mask (H, W) of the pixels inside a quadrangle (4, 2)."""
    return np.asarray(cv2.fillConvexPoly(np.zeros(shape, np.uint8), np.round(quad).astype(np.int32), 1) > 0)


def _chart_picture(frame: float) -> Floats:
    """Picture (h, w, 3) of a ColorChecker seen from the front, with a black frame `frame` patches wide."""
    patch = np.pad(np.ones((_PITCH - 2, _PITCH - 2, 1), np.float32), ((1, 1), (1, 1), (0, 0)))
    colors = shipped_data.colorchecker().rec709.reshape(4, 6, 3)
    picture = np.maximum(np.kron(colors, patch), 0.03).astype(np.float32)
    border = round(frame * _PITCH)
    return np.pad(picture, ((border, border), (border, border), (0, 0)), constant_values=0.03)
