"""Test materials: fixed by their number, within the stated ranges, with the stated spread of F0."""

from pathlib import Path

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.training import evaluation_materials

Library = list[evaluation_materials.TestMaterial]
Places = tuple[Floats, Floats]  # positions and directions (M, 3)


@pytest.fixture(scope="module")
def library(test_data: Path) -> Library:
    return evaluation_materials.test_materials(test_data / "materials" / "test")


@pytest.fixture(scope="module")
def places() -> Places:
    rng = np.random.default_rng(0)
    facing = rng.normal(size=(3000, 3))
    return rng.uniform(-0.5, 0.5, (3000, 3)), facing / np.linalg.norm(facing, axis=1, keepdims=True)


def test_materials_are_those_of_the_protocol(library: Library, places: Places) -> None:
    assert len(library) == 30 and len({m.name for m in library}) == 30
    samples = [material.at(*places) for material in library]
    assert np.std([sample.specular for sample in samples]) > 0.04
    assert min(m.ior for m in library) >= 1.4 and max(m.ior for m in library) <= 1.6
    for sample in samples:
        assert sample.diffuse.min() >= 0.005 and sample.diffuse.max() <= 0.95
        assert sample.roughness.min() >= 0.12 and sample.roughness.max() <= 1
        assert sample.specular.min() > 0.015 and sample.specular.max() < 0.41


def test_a_materials_maps_follow_one_pattern(library: Library, places: Places) -> None:
    related = 0
    for material in library[evaluation_materials.TEXTURES :]:
        sample = material.at(*places)
        assert sample.diffuse.std(axis=0).max() > 0.002, material.name
        related += abs(np.corrcoef(sample.diffuse.mean(axis=1), sample.roughness)[0, 1]) > 0.4
    assert related >= 15


def test_slopes_of_materials_are_bounded(library: Library, places: Places) -> None:
    for material in library[evaluation_materials.TEXTURES :]:
        steep = np.linalg.norm(material.slope(*places), axis=1)
        assert 0 < np.sqrt(np.mean(steep**2)) < 0.4 and steep.max() < 0.61, material.name


def test_without_texture_sets_the_patterns_remain(library: Library, tmp_path: Path, places: Places) -> None:
    alone = evaluation_materials.test_materials(tmp_path)
    assert [material.name for material in alone] == [one.name for one in library[evaluation_materials.TEXTURES :]]
    assert np.array_equal(alone[3].at(*places).diffuse, library[evaluation_materials.TEXTURES + 3].at(*places).diffuse)
