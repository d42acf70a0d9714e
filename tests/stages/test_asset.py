"""Maps and mesh to textures: glTF's own formulas, read backwards, give the maps again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from polcap.image_values import Floats
from polcap.mesh_values import Asset
from polcap.optics import color, frames
from polcap.optics.morphology import erode
from polcap.optics.texture_rasterizer import rasterize_frames
from polcap.stage_values import SurfaceMaps
from polcap.stages import asset, surface
from tests import surfaces


def rendered_normals(of: Asset, maps: SurfaceMaps, within: float = 0.01) -> tuple[Floats, tuple[Floats, Floats]]:
    """A renderer's normals at vertices on pixels, which those inside are: texture in the vertex's own frame."""
    mesh = of.mesh
    place = mesh.uv * [surfaces.WIDTH, surfaces.HEIGHT] - 0.5
    on = np.abs(place - np.rint(place)).max(axis=1) < within
    column, row = np.rint(place[on]).astype(int).T
    x, y, z = (of.normal[row, column] / 127.5 - 1).T[..., None]
    n, t = mesh.normals[on], mesh.tangents[on]
    return frames.unit(x * t[:, :3] + y * np.cross(n, t[:, :3]) * t[:, 3:] + z * n), (row, column)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("coarse", [False, True])
def test_renderer_sees_the_maps_normals_on_any_mesh(flat: bool, coarse: bool) -> None:
    maps = surfaces.maps(ripple=0.2)
    mesh = surfaces.flat_mesh(maps) if flat else surfaces.mesh(surfaces.maps())
    if coarse:
        mesh = surfaces.mesh(surfaces.maps(), surface.SurfaceSettings(max_vertices=2000))
    built = surfaces.built(maps, mesh)
    seen, (row, column) = rendered_normals(built, maps)
    error = frames.angle_deg(seen, maps.normal[row, column])
    steep = maps.normal[row, column][:, 2] < 0.1  # a flat mesh cannot show normals that leave it backwards
    assert np.percentile(error[~steep], 99) < 0.6  # 8 bits: 0.22° per component
    assert np.median(error) < 0.3


def test_shape_is_not_counted_twice() -> None:
    maps = surfaces.maps()
    built = surfaces.built(maps, surfaces.mesh(maps))
    inner = maps.mask & (maps.normal[..., 2] > 0.5)
    tilt = np.hypot(*(built.normal[inner][:, :2] / 127.5 - 1).T)
    assert np.degrees(np.median(tilt)) < 1.5  # the mesh carries the ball, the texture only the difference


def test_diffuse_and_specular_come_back_through_gltf_formulas() -> None:
    rng = np.random.default_rng(5)
    maps = surfaces.maps(roughness=0.37)
    diffuse, specular = (rng.uniform(*range_, (*maps.mask.shape, 3)) for range_ in ((0.05, 0.9), (0.02, 0.08)))
    maps = replace(maps, diffuse=diffuse.astype(np.float32), specular=specular.astype(np.float32))
    built = surfaces.built(maps, surfaces.mesh(surfaces.maps()))
    inner = ndimage.binary_erosion(maps.mask, np.ones((3, 3), bool))  # the outermost pixels are filled from there
    base = color.decode_srgb(built.base_color[inner] / 255)
    f0 = 0.04 * np.array(built.specular_factor) * color.decode_srgb(built.specular_color[inner] / 255)
    frontal = base * (1 - f0.max(axis=-1, keepdims=True))  # glTF: (1 − max F) base
    assert np.allclose(frontal, 0.96**2 * maps.diffuse[inner], atol=0.006)  # half a step of sRGB at white
    assert np.allclose(f0, maps.specular[inner], atol=0.0006)
    assert (built.occlusion_roughness_metallic[maps.mask] == [255, 94, 0]).all()


def test_base_color_takes_the_detail_of_raw_pixels_unless_switched_off() -> None:
    maps = surfaces.maps()
    detail = 0.3 * np.sin(2.0 * np.arange(2 * surfaces.WIDTH)) * np.ones((2 * surfaces.HEIGHT, 1))
    maps = replace(maps, diffuse=np.full_like(maps.diffuse, 0.3), detail=detail.astype(np.float16))
    mesh = surfaces.mesh(maps)
    built, plain = (asset.build(maps, mesh, asset.AssetSettings(raw_pixels=on)) for on in (True, False))
    assert built.base_color.shape == (*detail.shape, 3) and built.normal.shape == plain.base_color.shape
    expected = 0.96**2 * 0.3 * np.exp(detail)
    assert np.allclose(color.decode_srgb(built.base_color[..., 1] / 255), expected, atol=0.004)  # half a step of sRGB


def test_textures_reach_past_the_mask() -> None:
    maps = surfaces.maps()
    maps = replace(maps, diffuse=np.where(maps.mask[..., None], maps.diffuse, 0).astype(np.float32))
    built = surfaces.built(maps, surfaces.mesh(maps))
    assert built.base_color.max(axis=-1).min() > 80
    assert (built.normal[..., 2] > 127).all()


def test_black_specular_is_allowed() -> None:
    maps = surfaces.maps(specular=0.0)
    assert asset.build(maps, surfaces.mesh(maps), asset.AssetSettings()).specular_factor == (0.0, 0.0, 0.0)


def test_backdrop_does_not_show_along_the_outline() -> None:
    """Pixels of the outline that are half backdrop take the color of their neighbors."""
    maps = surfaces.maps()
    rim = maps.mask & ~ndimage.binary_erosion(maps.mask, np.ones((3, 3), bool))
    mixed = replace(maps, diffuse=np.where(rim[..., None], 0.1 * maps.diffuse, maps.diffuse).astype(np.float32))
    mesh = surfaces.mesh(maps)
    assert np.array_equal(surfaces.built(mixed, mesh).base_color, surfaces.built(maps, mesh).base_color)


def test_walls_and_back_do_not_change_the_normal_texture() -> None:
    maps = surfaces.maps(ripple=0.2)
    seen, closed = (surfaces.mesh(maps, surface.SurfaceSettings(back=back)) for back in ("open", "closed"))
    assert np.array_equal(surfaces.built(maps, closed).normal, surfaces.built(maps, seen).normal)


def test_textures_take_the_size_asked_for_and_a_sliver_keeps_a_pixel() -> None:
    maps = surfaces.maps()
    built = surfaces.built(maps, surfaces.mesh(maps))
    for size in (64, 256, 1024):
        other = asset.resize_textures(built, size)
        assert other.base_color.shape == other.normal.shape == (size, size, 3)
        assert np.abs(np.linalg.norm(other.normal / 127.5 - 1, axis=-1) - 1).max() < 0.02
        assert other.base_color.mean((0, 1)) == pytest.approx(built.base_color.mean((0, 1)), abs=1)
    textures = ("base_color", "occlusion_roughness_metallic", "normal", "specular_color")
    sliver = replace(built, **{name: getattr(built, name)[:1] for name in textures})
    assert asset.resize_textures(sliver, 16).normal.shape == (1, 16, 3)


def test_frames_are_interpolated_as_by_a_renderer() -> None:
    """Against the barycentric formula, corner by corner, on triangles of any shape."""
    rng = np.random.default_rng(3)
    mesh = surfaces.mesh(surfaces.maps(), surface.SurfaceSettings(max_vertices=2000))
    value = np.concatenate([mesh.normals, mesh.tangents], axis=-1)
    there, covered = rasterize_frames(mesh, surfaces.HEIGHT, surfaces.WIDTH)
    place = mesh.uv * [surfaces.WIDTH, surfaces.HEIGHT] - 0.5
    number = np.cumsum(covered).reshape(covered.shape) - 1
    found = 0
    for face in mesh.faces[rng.choice(len(mesh.faces), 60)]:
        a, b, c = place[face].astype(np.float64)
        low, high = np.ceil(np.min([a, b, c], axis=0)).astype(int), np.floor(np.max([a, b, c], axis=0)).astype(int)
        for x, y in ((x, y) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1)):
            share = np.linalg.solve(np.stack([[*a, 1], [*b, 1], [*c, 1]], axis=-1), [x, y, 1])
            if share.min() > -1e-6:  # on an edge both triangles agree
                assert covered[y, x]
                assert there[number[y, x]] == pytest.approx(share @ value[face], abs=2e-4)
                found += 1
    assert found > 60


def test_the_curvature_of_a_ball_is_that_of_its_radius() -> None:
    """A twentieth above one half, if its outline were of its radius; nearer parts are larger. Its hollow is below."""
    ball = surfaces.maps()
    found = asset.curvature(ball)
    inner = erode(ball.mask, 6, from_border=True) & (ball.normal[..., 2] > 0.5)
    outline, radius = np.ptp(np.flatnonzero(ball.mask.any(axis=0))) / 2, 400 * surfaces.RADIUS / surfaces.DISTANCE
    assert np.median(found[inner]) - 0.5 == pytest.approx(outline / radius / 20, rel=0.05)
    hollow = replace(ball, normal=ball.normal * np.array([-1, -1, 1], np.float32))
    assert np.median(asset.curvature(hollow)[inner]) - 0.5 == pytest.approx(-outline / radius / 20, rel=0.05)
