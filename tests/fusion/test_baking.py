"""Baking: views outvote errors, hidden surface takes nothing, and no view ends at a visible seam."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.fusion import atlas as atlases
from polcap.fusion import baking, comparison, fused_page
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, BakingSettings
from polcap.fusion.values import ClosedMesh
from polcap.optics.frames import angle_deg
from polcap.stages import asset
from tests.fusion import ellipsoid

RING = ellipsoid.views(8)


def test_maps_without_errors_are_baked_as_they_are(atlas: Atlas, baked: AtlasMaps) -> None:
    seen = baked.seen[atlas.covered]
    assert seen.mean() > 0.8
    assert angle_deg(baked.normal[atlas.covered], ellipsoid.normals(atlas.position))[seen].mean() < 0.5
    error = baked.diffuse[atlas.covered] - ellipsoid.albedo(atlas.position)
    assert np.abs(error[seen]).mean() < 0.01
    assert baked.roughness[baked.seen] == pytest.approx(0.4, abs=1e-4)


def test_views_with_independent_errors_outvote_each_other(atlas: Atlas) -> None:
    views = tuple(ellipsoid.tilted(view, 8.0, seed) for seed, view in enumerate(RING))
    made = baking.bake(views, atlas, BakingSettings(mesh_sigma_deg=90))  # the mesh, which is the truth, has no vote
    single = angle_deg(views[0].normal, RING[0].normal)[RING[0].mask].mean()
    seen = made.seen[atlas.covered]
    error = angle_deg(made.normal[atlas.covered], ellipsoid.normals(atlas.position))[seen].mean()
    assert error < 0.8 * single  # a texel is seen by two to three of them


def test_a_half_turn_in_one_view_is_outvoted(atlas: Atlas) -> None:
    wrong = RING[0].normal * [-1, -1, 1]
    views = (replace(RING[0], normal=wrong.astype(np.float32)), *RING[1:])
    made = baking.bake(views, atlas, BakingSettings(mesh_sigma_deg=90))
    seen = made.seen[atlas.covered]
    error = angle_deg(made.normal[atlas.covered], ellipsoid.normals(atlas.position))[seen]
    assert np.median(error) < 2 and angle_deg(wrong, RING[0].normal)[RING[0].mask].mean() > 30


def test_a_part_behind_another_takes_nothing_from_the_view() -> None:
    front = ellipsoid.mesh(3)
    behind = front.vertices - np.array([0.0, 0.0, 0.15], np.float32)
    both = ClosedMesh(
        np.concatenate([front.vertices, behind]), np.concatenate([front.faces, front.faces + len(behind)])
    )
    atlas = atlases.chart(both, 256, 6)
    (view,) = ellipsoid.views(1, elevation_deg=0)
    (visible,) = baking.visible_texels([view], atlas)
    assert len(visible.texel) > 1000
    assert (atlas.position[visible.texel, 2] > -0.06).all()


def test_a_views_weight_fades_out_at_its_outline(atlas: Atlas) -> None:
    (visible,) = baking.visible_texels(RING[:1], atlas)
    middle = (np.array([ellipsoid.PIXELS] * 2) - 1) / 2
    away = np.linalg.norm(visible.pixel - middle, axis=-1)
    assert visible.weight[away > away.max() - 2].max() < 0.05
    assert visible.weight[away < 10].min() > 0.8


def test_texels_between_the_charts_have_the_nearest_values(atlas: Atlas) -> None:
    maps = baking.on_atlas(atlas, np.ones((len(atlas.position), 11)))
    assert not maps.mask.all()
    assert (maps.diffuse == 1).all()
    assert not maps.seen[~maps.mask].any()


def test_the_asset_stage_turns_the_atlas_into_tangent_space(atlas: Atlas, baked: AtlasMaps) -> None:
    """Textures of the closed mesh come from the same code as those of a single view."""
    found = asset.build(baked, atlas.mesh, asset.AssetSettings())
    local = found.normal[atlas.covered] / 127.5 - 1
    assert np.degrees(np.arccos(np.clip(local[..., 2], -1, 1))).mean() < 1.5  # the mesh has the true normals
    assert found.specular_factor[0] == pytest.approx(1.0, rel=1e-3)


def test_a_view_without_a_photograph_has_no_residual_and_a_row_in_the_report(atlas: Atlas, baked: AtlasMaps) -> None:
    bare = replace(RING[0], s0=None)
    (found,) = comparison.compare((bare,), atlas, baked).views
    assert found.residual is None and found.normal_deg < 1
    row = {
        "name": "view01", "corners": 30, "reprojection_px": 0.1, "pose_sigma_deg": 0.1,
        "normal_deg": found.normal_deg, "residual": found.residual, "verdict": "pass",
    }  # fmt: skip
    assert fused_page._row(row)[-2:] == ("–", "pass")
