"""Highlights of all views together tell F0 and roughness where every view's maps err alike."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.fusion import comparison, filling, material_fit
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.material_fit import MaterialSettings
from tests.fusion import ellipsoid

RING = ellipsoid.views(8)


def test_the_lobe_is_found_from_the_highlights_of_all_views(atlas: Atlas, baked: AtlasMaps) -> None:
    settings = MaterialSettings(f0_sigma=1, roughness_sigma=1)
    found = material_fit.fit(RING, atlas, baked, settings)
    seen = found.seen & atlas.covered
    assert np.median(found.specular[seen]) == pytest.approx(ellipsoid.F0, rel=0.1)
    assert np.median(found.roughness[seen]) == pytest.approx(ellipsoid.ROUGHNESS, abs=0.03)


def test_the_albedo_becomes_that_of_the_radiance(atlas: Atlas, baked: AtlasMaps) -> None:
    """Maps that are a tenth too dark, under a light whose strength a chart has given."""
    views = tuple(replace(view, white_distance=1.0, diffuse=0.9 * view.diffuse) for view in RING)
    found = material_fit.fit(views, atlas, replace(baked, diffuse=0.9 * baked.diffuse), MaterialSettings())
    seen = baked.weight[atlas.covered] > 0.5
    ratio = found.diffuse[atlas.covered][seen] / baked.diffuse[atlas.covered][seen]
    assert np.median(ratio) == pytest.approx(1, abs=0.03)


def test_views_without_photographs_keep_their_maps(atlas: Atlas, baked: AtlasMaps) -> None:
    views = tuple(replace(view, s0=None) for view in RING)
    assert material_fit.fit(views, atlas, baked, MaterialSettings()) is baked


def test_the_fit_brings_the_rendering_nearer_to_the_photographs(atlas: Atlas, baked: AtlasMaps) -> None:
    views = ellipsoid.views(8, flash=(0.0, 0.0, 0.0))
    fitted = material_fit.fit(views, atlas, baked, MaterialSettings())
    before, after = (comparison.compare(views, atlas, maps).views for maps in (baked, fitted))
    assert np.mean([one.residual for one in after]) < 0.7 * np.mean([one.residual for one in before])


def test_unseen_surface_is_filled_without_a_step(atlas: Atlas, baked: AtlasMaps) -> None:
    """The bottom, which no view of the ring saw, continues the colors around it."""
    filled = filling.fill(baked, atlas)
    unseen = ~filled.seen[atlas.covered]
    assert unseen.mean() > 0.05
    values = filled.diffuse[atlas.covered]
    assert values[unseen].min() > 0.15 and values[unseen].max() < 0.65  # within those of the surface
    assert filled.roughness[atlas.covered] == pytest.approx(0.4, abs=0.01)
    kept = baked.weight[atlas.covered] > 0.5
    assert np.array_equal(values[kept], baked.diffuse[atlas.covered][kept])
