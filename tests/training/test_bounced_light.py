"""Bounced light in training against that of `light_transport`, on a bowl seen from inside and from outside."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from polcap.image_values import Floats, View
from polcap.optics import frames, shade
from polcap.optics.mesh_tracer import Tracer, Triangles, smooth, union
from polcap.training import bounced_light, light_transport, random_shapes, traced_views
from polcap.training.materials import Surface
from polcap.training.simulator import Simulator

SIZE, ALBEDO, F0, ROUGHNESS = 96, 0.6, 0.08, 0.35


def _bowl() -> Triangles:
    """A thin half sphere, open towards z."""
    unit, faces = random_shapes._sphere(121, 120)
    lower = faces[unit[faces][..., 2].max(axis=1) < 1e-9]
    return union([smooth(0.48 * unit, lower[:, ::-1]), smooth(0.5 * unit, lower)])


def _both(turn: Floats) -> tuple[Floats, Floats]:
    """Stokes parameters (3, M, 3) of one-bounce light: as in training, and as in `light_transport.py`."""
    mesh = _bowl()
    translation, view = np.array([0, 0, -4.0]), View(3.3 * SIZE, ((SIZE - 1) / 2, (SIZE - 1) / 2), 1.0)
    scene = Tracer(mesh)
    buffer = scene.trace(turn, translation, view, SIZE, SIZE)
    pose, mask = light_transport.LitPose(turn, translation, np.zeros(3), 16.0), buffer.mask
    lit, met = bounced_light.trace_visibility(scene, buffer, pose, np.random.default_rng(1))
    middle, unit = traced_views.depth_unit(mask, buffer.depth, view.focal)
    camera = np.array([[view.focal, *view.center, middle, unit, *turn.reshape(-1), 0, 0]], np.float32)
    depth = np.where(mask, (buffer.depth - middle) / unit, 0)
    cache = {"normal": buffer.normal, "depth": depth[..., None], "position": buffer.position, "met": met}
    cache |= {"mask": mask[..., None], "lit": lit[..., None]}
    simulator = Simulator({k: v[None] for k, v in cache.items()} | {"camera": camera}, None, torch.device("cpu"))
    seen = simulator.gather(np.array([0]), SIZE, flip=False).pixels

    v, ones = frames.rays(view, SIZE, SIZE)[mask].astype(float), np.ones((int(mask.sum()), 3))
    normal = frames.to_ray_frame(buffer.normal[mask], v).astype(float)
    material = (ALBEDO * ones, F0 * ones, np.full(len(ones), ROUGHNESS))
    _, flat = scene.first_hits(np.broadcast_to(-translation @ turn, v.shape), -v @ turn)
    position = buffer.position[mask].astype(float)
    places = light_transport.SurfacePoints(mask, position, flat, normal, v, *material, ior=1.5)
    indirect = light_transport.IndirectLight(scene, places, pose, lambda place, _: ALBEDO * np.ones((len(place), 3)))
    traced = indirect.diffuse(np.random.default_rng(2)) + indirect.mirrored(np.random.default_rng(3))

    local = torch.from_numpy(normal).float()
    flash = frames.to_ray_frame(-seen.place / seen.place.norm(dim=1, keepdim=True), seen.v)
    surface = Surface(local, *(torch.from_numpy(a).float() for a in (*material, np.full(len(ones), 1.5))))
    gloss = 0 * surface.specular, surface.roughness, surface.ior
    body = shade.stokes(local, surface.diffuse, *gloss, flash, seen.lit / (seen.place**2).sum(dim=1))
    return bounced_light.bounced_stokes(seen, local, surface, body[0]).numpy(), traced


def _turned(degrees: float) -> Floats:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


@pytest.mark.parametrize("degrees", [0, 25])
def test_bounced_light_inside_a_bowl_agrees_with_tracing(degrees: float) -> None:
    trained, traced = _both(_turned(degrees))
    assert trained[0].sum() == pytest.approx(traced[0].sum(), rel=0.2)
    for k in (1, 2):  # mirrored light is polarized: at the same pixels, in the same direction, as strongly
        assert np.corrcoef(trained[k].mean(axis=-1), traced[k].mean(axis=-1))[0, 1] > 0.7
        assert np.abs(trained[k]).sum() == pytest.approx(np.abs(traced[k]).sum(), rel=0.4)


def test_the_outside_of_a_bowl_gets_almost_no_bounced_light() -> None:
    inside, outside = (_both(_turned(degrees))[0] for degrees in (0, 180))
    assert outside[0].mean() < 0.03 * inside[0].mean()


def test_outline_of_dark_gloss_shows_the_backdrop_polarized_across_the_normal() -> None:
    polar = torch.linspace(0.05, 1.55, 60)
    normal = torch.stack([torch.sin(polar), 0 * polar, torch.cos(polar)], dim=1)
    v = torch.tensor([[0.0, 0.0, 1.0]]).expand(60, 3)
    ones = torch.ones(60)
    surface = Surface(normal, 0.03 * torch.ones(60, 3), 0.04 * torch.ones(60, 3), 0.2 * ones, 1.5 * ones)
    place, flash = 0.2 * normal - v, torch.zeros(1, 3)
    seen: Any = SimpleNamespace(v=v, owner=torch.zeros(60).long(), place=place, open=ones)
    mirrored = partial(bounced_light.mirrored_surroundings, seen, flash, normal, surface, torch.ones(1))
    torch.manual_seed(1)
    rooms = torch.stack([mirrored() for _ in range(40)])
    light, along = rooms[:, 0].mean(dim=-1), rooms[:, 1].mean(dim=-1)  # the normals lean along x
    assert 0.4 < (light[:, -1] > 0).float().mean() < 0.9  # some objects have no surroundings
    assert (along <= 1e-6).all() and light[:, -1].mean() > 5 * light[:, 20].mean()
    seen.open = torch.zeros(60)
    assert mirrored().abs().max() == 0
