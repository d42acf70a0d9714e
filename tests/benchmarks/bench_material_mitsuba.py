"""Errors of materials of flat samples that Mitsuba path-traces, with interreflection; their boards are polcap's.

PYTHONPATH=. python tests/benchmarks/bench_material_mitsuba.py FOLDER [options of bench_material.py]

The relief is a mesh with one albedo for each triangle, and steps of 0.02 in roughness. All shots of a view have the
same pixels. S1 and S2 of samples under the rough law are scaled, as in `bench_mitsuba`.
"""

from functools import partial
from typing import Any
from unittest.mock import patch

import bench_material
import cv2
import msgspec
import numpy as np
from bench_captures import facet_share
from make_mitsuba import scene, seen, shot, square_crop

from polcap.image_values import Bools, Floats, View
from polcap.optics import frames, fresnel
from polcap.synth import render, scene_materials, trace
from polcap.synth.flat_views import FlatShoot
from polcap.synth.render import Scene

CELLS = 320  # of the mesh along a side
PASSES, DEPTH = 3, 5  # of PASS samples per pixel; longest path
STEP = 0.02  # of roughness


def main() -> None:
    traced = partial(path_traced, render.stokes)
    with (
        patch.object(render, "stokes", traced),
        patch.object(bench_material, "scene", partial(still, bench_material.scene)),
    ):
        bench_material.main()


def still(scene_of: Any, *sample: Any) -> tuple[Scene, FlatShoot]:
    """Scene and sample of `bench_material.scene`, with a camera that does not move between the shots."""
    made, shoot = scene_of(*sample)
    return made, msgspec.structs.replace(shoot, nudge_px=0, nudge_deg=0)


def path_traced(stokes: Any, of: Scene, view: View, x: Floats, y: Floats, *others: Any) -> Floats:
    """Stokes parameters (3, H, W, 3) of `render.stokes`, with pixels inside the sample's upper side by Mitsuba."""
    out: Floats = stokes(of, view, x, y, *others)
    mask = render.gbuffer(of, view, *x.shape).mask
    crop, size, inside = square_crop(mask, view, 0)
    light, inner = traced(of, crop, size)
    height, width = mask[inside].shape
    at = inner[:height, :width] & mask[inside]
    out[:, *inside][:, at] = light[:, :height, :width][:, at]
    return out


def traced(of: Scene, view: View, size: int) -> tuple[Floats, Bools]:
    """Stokes parameters (3, size, size, 3) of the sample, and the pixels (size, size) that it covers."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    parts = mesh(of)
    truth = seen(mi, parts, view, size)
    squared = np.sum((np.array(of.light) - np.array(of.position)) ** 2)  # m², where polcap's white has S0 = 1
    out = np.zeros((3, size, size, 3))
    for k, channel in enumerate("rgb"):
        one = scene(mi, parts, channel, list(of.light), np.pi * squared, view, size, DEPTH, {})
        out[..., k] = np.mean([shot(mi, one, view, seed=3 * number + k) for number in range(PASSES)], axis=0)
    if of.law == "rough":
        rays = frames.rays(view, size, size)
        out[1:] *= facet_share(truth["normal"], truth["roughness"] ** 2, truth["ior"], rays)[..., None]
    return out, cv2.erode(truth["mask"].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def mesh(of: Scene) -> list[dict[str, Any]]:
    """Triangles of the sample's upper side before the camera, in parts of one gloss, as `make_mitsuba.body` needs."""
    slab: Any = of.shape
    axis = np.linspace(-0.5, 0.5, CELLS + 1) * slab.side
    x, z = np.meshgrid(axis, axis)
    point = np.stack([x, slab.thickness + slab.height(x, z), z], axis=-1)
    normal = trace.gradient(slab, point)
    corners = [np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[1:, 1:], np.s_[:-1, 1:]]  # anticlockwise from above
    corner, facing = (
        np.concatenate(
            [np.stack([one[corners[k]].reshape(-1, 3) for k in three], axis=1) for three in ((0, 1, 2), (0, 2, 3))]
        )
        for one in (point, normal)
    )  # (F, 3, 3)
    middle = corner.mean(axis=1)
    albedo, specular, roughness, ior = scene_materials.evaluate(
        of.coat, middle, np.tile([0.0, 1.0, 0.0], (len(middle), 1))
    )
    gloss = np.stack([STEP * np.rint(roughness / STEP), specular[:, 0], ior], axis=-1).round(6)
    kinds, member = np.unique(gloss, axis=0, return_inverse=True)
    turn, position = of.turn.as_matrix(), np.array(of.position)
    return [
        {
            "position": corner[which] @ turn.T + position,
            "normal": facing[which] @ turn.T,
            **{name: albedo[which, c] for c, name in enumerate("rgb")},
            "strength": float(f0 / fresnel.normal_reflectance(index)),
            "alpha": float(rough**2),
            "ior": float(index),
        }
        for k, (rough, f0, index) in enumerate(kinds)
        if (which := member.ravel() == k).any()
    ]


if __name__ == "__main__":
    main()
