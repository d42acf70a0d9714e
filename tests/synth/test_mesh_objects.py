"""Meshes in synthetic scenes: same light as on distance fields, shadows, one bounce, texture sets."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from msgspec.structs import replace

pytest.importorskip("embreex")

from polcap.errors import DecodeError, SettingError
from polcap.image_values import Floats, View
from polcap.optics import frames, mesh_tracer
from polcap.synth import interreflection, render
from polcap.synth.distance_fields import Cluster, Model
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material, add_relief, evaluate
from polcap.synth.scenes import with_textures

VIEW = View(focal=160.0, center=(47.5, 35.5), scale=1.0)
GREY = Coat((Material((0.6, 0.6, 0.6), (0.6, 0.6, 0.6), "plain", roughness=(0.5, 0.5)),))
BALL = Scene(Cluster(((0, 0, 0, 0.08),)), GREY, position=(-0.05, 0.02, -0.7), light=(0.1, 0.05, 0.0), chart=None)
Y, X = np.mgrid[:72, :96].astype(float)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Model:
    file = tmp_path_factory.mktemp("mesh") / "ball.ply"
    trimesh.creation.icosphere(subdivisions=5, radius=3.0).apply_translation([1, 2, 3]).export(file)
    return Model(str(file), 0.08)


def test_a_ball_of_triangles_renders_like_a_ball(model: Model) -> None:
    solid = render.stokes(BALL, VIEW, X, Y)
    triangles = render.stokes(replace(BALL, shape=model), VIEW, X, Y)
    seen = render.gbuffer(BALL, VIEW, 72, 96)
    core = cv2.erode(seen.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    np.testing.assert_allclose(triangles[0][core], solid[0][core], rtol=0.01)
    assert np.abs(triangles[1:] - solid[1:])[:, core].max() < 0.03 * np.abs(solid[1:][:, core]).max()
    depth = render.gbuffer(replace(BALL, shape=model), VIEW, 72, 96).depth
    np.testing.assert_allclose(depth[core], seen.depth[core], atol=5e-5)


@pytest.mark.parametrize("kind", ["solid", "mesh"])
def test_points_are_in_shadow_where_the_line_to_the_flash_crosses_the_ball(model: Model, kind: str) -> None:
    scene = replace(BALL, light=(0.3, 0.0, 0.0), **({"shape": model} if kind == "mesh" else {}))
    bright = render.stokes(scene, VIEW, X, Y)[0, ..., 0]
    dark = render.stokes(replace(scene, cast_shadows=True), VIEW, X, Y)[0, ..., 0]
    v = frames.rays_at(VIEW, X, Y)
    wall = -v * (scene.backdrop / v[..., 2])[..., None]
    light, middle = np.array(scene.light), np.array(scene.position)
    way = (light - wall) / np.linalg.norm(light - wall, axis=-1, keepdims=True)
    along = ((middle - wall) * way).sum(-1)
    missed = np.linalg.norm(wall + along[..., None] * way - middle, axis=-1)
    background = ~render.gbuffer(scene, VIEW, 72, 96).mask
    shadow, free = background & (missed < 0.079), background & (missed > 0.081)
    assert shadow.sum() > 50
    assert (dark[shadow] == 0).all() and (dark[free] == bright[free]).all()


def test_every_point_of_a_hemispherical_bowl_receives_the_light_of_half_a_sphere() -> None:
    """Between any two patches of a sphere the form factor is area/4πR²; a bowl's is ½."""
    whole = trimesh.creation.icosphere(subdivisions=4, radius=0.08)
    bowl = whole.faces[whole.triangles_center[:, 2] < 0]
    tracer = mesh_tracer.Tracer(mesh_tracer.smooth(whole.vertices, bowl))

    def shining(point: Floats, normal: Floats, towards: Floats) -> Floats:
        assert (np.einsum("ni,ni->n", point, normal) < 0).all()  # met from inside
        return np.ones((len(point), 3))

    inside = np.unique(bowl[whole.vertices[bowl][..., 2].max(axis=1) < -0.03])
    found = interreflection.gather(tracer, shining, np.array([0.0, 0.0, 0.01]), 1.0)[inside, 0]
    assert abs(found.mean() - 0.5) < 0.01
    assert np.abs(found - 0.5).max() < 0.1  # 48 rays each


def test_a_ball_does_not_light_itself_and_distance_fields_are_refused(model: Model) -> None:
    direct, bounced = (
        render.stokes(replace(BALL, shape=model, interreflection=on), VIEW, X, Y) for on in (False, True)
    )
    np.testing.assert_allclose(bounced, direct, atol=1e-6)
    with pytest.raises(SettingError, match="as a mesh"):
        render.stokes(replace(BALL, interreflection=True), VIEW, X, Y)


@pytest.fixture
def texture(tmp_path: Path) -> Path:
    ramp = np.tile(np.linspace(60, 200, 512), (512, 1)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "albedo.jpg"), np.full((64, 64, 3), (188, 0, 0), np.uint8))  # blue, green, red
    cv2.imwrite(str(tmp_path / "roughness.jpg"), np.full((64, 64), 102, np.uint8))
    cv2.imwrite(str(tmp_path / "height.jpg"), ramp)
    return tmp_path


def test_a_texture_set_gives_color_roughness_and_relief(texture: Path) -> None:
    coat = with_textures(BALL, texture).coat
    position, facing = np.array([[0.03, 0.045, 0.0], [0.13, 0.045, 0.0]]), np.array([[0.0, 0.0, 1.0]] * 2)
    diffuse, _, roughness, _ = evaluate(coat, position, facing)
    np.testing.assert_allclose(diffuse, [[0, 0, 0.503]] * 2, atol=0.02)  # sRGB 188
    np.testing.assert_allclose(roughness, 0.4, atol=0.01)
    bent = add_relief(coat, position, facing)
    assert bent[0, 0] < -0.02 and bent[1, 0] > 0.02  # up the ramp, and down its mirror image
    np.testing.assert_allclose(bent[:, 1], 0, atol=0.02)


def test_unreadable_files_are_refused_in_one_line(tmp_path: Path, texture: Path) -> None:
    (tmp_path / "nothing.ply").write_text("ply?")
    for broken in ("nothing.ply", "absent.obj", "absent.npz"):
        with pytest.raises(DecodeError, match=broken):
            render.stokes(replace(BALL, shape=Model(str(tmp_path / broken), 0.08)), VIEW, X, Y)
    (texture / "roughness.jpg").unlink()
    with pytest.raises(DecodeError, match=r"roughness\.jpg is missing"):
        render.stokes(with_textures(BALL, texture), VIEW, X, Y)
