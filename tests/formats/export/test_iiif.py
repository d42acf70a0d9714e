"""The IIIF folder has every picture of its manifest, and Ward's law shades it as polcap shades the maps."""

import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from polcap.errors import SettingError
from polcap.formats.export import iiif, relightable_layer
from polcap.formats.export.texture_set import Texture
from polcap.image_values import Floats
from polcap.mesh_values import Asset, ReliefMesh
from polcap.optics import color, shade
from polcap.stages import asset
from tests import surfaces

ADDRESS = "https://museum.example/objects/7"
FACTS = {"name": "IMG_1", "title": "Vase", "creator": "A. Photographer", "rights": "© Museum", "object_number": "7"}
FACTS |= {"license": "https://creativecommons.org/licenses/by/4.0/"}


def waves(height: int, width: int) -> Texture:
    row, column = np.mgrid[:height, :width] / 40.0
    return Texture((127 + 60 * np.sin(row) + 60 * np.cos(column)).astype(np.uint8), False, "waves")


@pytest.mark.parametrize(("width", "height"), [(1, 1), (300, 512), (513, 200), (1500, 1101)])
def test_each_request_of_the_image_api_finds_its_part(tmp_path: Path, width: int, height: int) -> None:
    """Image API 3.0 §4 and its notes on tiles: region in full pixels, size rounded up, in every scale factor."""
    picture = waves(height, width)
    iiif.write(tmp_path, {"one": picture}, FACTS, ADDRESS)
    info = json.loads((tmp_path / "one" / "info.json").read_text())
    assert (info["width"], info["height"], info["profile"]) == (width, height, "level0")
    (tiles,) = info["tiles"]
    for factor in tiles["scaleFactors"]:
        side = tiles["width"] * factor
        for x, y in product(range(0, width, side), range(0, height, side)):
            w, h = min(side, width - x), min(side, height - y)
            size = (int(np.ceil(w / factor)), int(np.ceil(h / factor)))
            seen = read(tmp_path, f"one/{x},{y},{w},{h}/{size[0]},{size[1]}")
            wanted = cv2.resize(picture.pixels[y : y + h, x : x + w], size, interpolation=cv2.INTER_AREA)
            assert seen.shape == wanted.shape and np.abs(seen.astype(float) - wanted).mean() < 2
    for size in (*info["sizes"], None):
        found = read(tmp_path, "one/full/" + (f"{size['width']},{size['height']}" if size else "max"))
        assert found.shape == ((size["height"], size["width"]) if size else (height, width))
    assert max(info["sizes"][0].values()) <= tiles["width"]  # the coarsest is one tile


def read(folder: Path, request: str) -> np.ndarray:
    return np.asarray(cv2.imread(str(folder / request / "0" / "default.jpg"), cv2.IMREAD_UNCHANGED))


def test_manifest_has_what_the_presentation_api_requires() -> None:
    """Presentation API 3.0: §3 properties, §5 structure, §4.2 identity and §4.4 language maps."""
    made = iiif.manifest({"albedo": waves(30, 40), "normal": waves(30, 40)}, FACTS, ADDRESS)
    assert made["@context"] == "http://iiif.io/api/presentation/3/context.json"
    assert (made["id"], made["type"], made["label"]) == (f"{ADDRESS}/manifest.json", "Manifest", {"none": ["Vase"]})
    assert made["rights"] == "http://creativecommons.org/licenses/by/4.0/"  # the address that the license itself has
    assert made["requiredStatement"]["value"] == {"none": ["© Museum"]}
    assert [one["label"]["en"][0] for one in made["metadata"]] == ["Creator", "License", "Identifier"]
    known = set()
    for canvas in made["items"]:
        (page,) = canvas["items"]
        (annotation,) = page["items"]
        body = annotation["body"]
        kinds = [one["type"] for one in (canvas, page, annotation, body, *body["service"])]
        assert kinds == ["Canvas", "AnnotationPage", "Annotation", "Image", "ImageService3"]
        assert annotation["motivation"] == "painting" and annotation["target"] == canvas["id"]
        assert (canvas["width"], canvas["height"]) == (body["width"], body["height"]) == (40, 30)
        assert body["id"] == f"{body['service'][0]['id']}/full/max/0/default.jpg"
        known |= {one["id"] for one in (canvas, page, annotation, body)}
    assert len(known) == 8 and all(one.startswith(ADDRESS) and "#" not in one for one in known)


def test_a_license_without_an_address_is_no_rights_statement() -> None:
    made = iiif.manifest({}, {"name": "IMG_1", "license": "CC BY 4.0"}, ADDRESS)
    assert "rights" not in made and "requiredStatement" not in made and made["label"] == {"none": ["IMG_1"]}
    assert made["metadata"] == [{"label": {"en": ["License"]}, "value": {"none": ["CC BY 4.0"]}}]


def test_an_address_outside_the_web_is_refused() -> None:
    with pytest.raises(SettingError, match="--iiif objects/7 is no web address"):
        iiif.check("objects/7")


@pytest.fixture(scope="module")
def ball() -> Asset:
    maps = surfaces.maps(roughness=0.5, specular=0.04)
    mesh = surfaces.mesh(maps)
    made = asset.with_extras(surfaces.built(maps, mesh), maps, mesh.depth, occlusion=False)
    height, width = maps.mask.shape
    return replace(made, base_color=cv2.resize(made.base_color, (2 * width, 2 * height)))  # as with RAW detail


def test_compression_changes_normals_by_half_a_degree_at_most(ball: Asset, tmp_path: Path) -> None:
    made = relightable_layer.pictures(ball)
    iiif.write(tmp_path, made, FACTS, ADDRESS)
    before, after = (unit(one) for one in (made["normal"].pixels, read(tmp_path, "normal/full/max")[..., ::-1]))
    assert isinstance(ball.mesh, ReliefMesh)
    inner = cv2.erode((ball.mesh.depth > 0).astype(np.uint8), np.ones((5, 5), np.uint8))
    inside = cv2.resize(inner, before.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    angle = np.degrees(np.arccos(np.clip((before * after).sum(-1)[inside], -1, 1)))
    assert 0 < np.median(angle) < 0.5 and np.percentile(angle, 95) < 1


def unit(coded: np.ndarray) -> Floats:
    """Normals of 8-bit pixels, each of length 1."""
    normal = coded / 127.5 - 1
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9))


def test_pictures_of_an_upright_camera_stand_upright(ball: Asset) -> None:
    lying, upright = relightable_layer.pictures(ball), relightable_layer.pictures(asset.turn(ball, 90))
    np.testing.assert_array_equal(upright["albedo"].pixels, np.rot90(lying["albedo"].pixels))
    x, y, z = np.moveaxis(np.rot90(lying["normal"].pixels).astype(int), -1, 0)
    assert np.abs(upright["normal"].pixels - np.stack([255 - y, x, z], axis=-1)).max() <= 1


@pytest.mark.parametrize("light", [(0.0, 0.0, 1.0), (0.5, 0.0, 0.8), (-0.3, -0.6, 0.7)])
def test_wards_law_shows_the_layer_as_polcap_shades_the_maps(
    ball: Asset, tmp_path: Path, light: tuple[float, ...]
) -> None:
    """Both laws have the same lobe near the mirror direction; Ward's has no Fresnel term: 10 % at 60°."""
    iiif.write(tmp_path, relightable_layer.pictures(ball), FACTS, ADDRESS)
    to_light = np.array(light) / np.linalg.norm(light)
    maps = surfaces.maps(roughness=0.5, specular=0.04)
    one = np.ones(maps.mask.shape)
    shown_as = maps.normal, maps.diffuse, maps.specular, maps.roughness, 1.5 * one
    wanted = shade.stokes(*shown_as, to_light + 0 * maps.normal, one)[0]
    seen, drawn = ward(tmp_path, to_light)
    half = (slice(None, None, 2), slice(None, None, 2))
    shown = drawn[half] & maps.mask
    around = cv2.dilate(maps.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # the outline is soft
    assert shown.sum() > 0.97 * maps.mask.sum() and (drawn[half] & ~around).sum() < 0.02 * maps.mask.sum()
    inner = cv2.erode(maps.mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    near = inner & (maps.normal @ to_light > 0.5) & (maps.normal[..., 2] > 0.5)
    assert near.sum() > 1000
    error = np.abs(seen[half] - wanted)[near] / np.percentile(wanted[near], 99)
    assert np.median(error) < 0.03 and np.percentile(error, 95) < 0.1


def ward(folder: Path, to_light: Floats) -> tuple[Floats, np.ndarray]:
    """(H, W, 3) of a layer under a light of irradiance π, and where it is drawn: Ward 1992, eq. (4), isotropic."""
    names = ("albedo", "specular", "normal", "gloss")
    albedo, f0, coded, gloss = (read(folder, f"{name}/full/max") / 255.0 for name in names)
    normal = 2 * coded[..., ::-1] - 1
    length = np.linalg.norm(normal, axis=-1)
    normal /= np.maximum(length, 1e-9)[..., None]
    half = to_light + np.array([0, 0, 1])
    cos_i, cos_o, cos_h = (normal @ one for one in (to_light, np.array([0, 0, 1.0]), half / np.linalg.norm(half)))
    slope = (1 - gloss) ** 4
    lobe = np.exp(-(np.tan(np.arccos(np.clip(cos_h, 1e-3, 1))) ** 2) / slope**2) / (4 * np.pi * slope**2)
    lobe /= np.sqrt(np.maximum(cos_i * cos_o, 1e-3))
    diffuse, specular = (color.decode_srgb(one[..., ::-1]) for one in (albedo, f0))
    return np.pi * (diffuse / np.pi + specular * lobe[..., None]) * np.maximum(cos_i, 0)[..., None], length > 0.5


def test_every_address_of_a_manifest_is_percent_encoded(tmp_path: Path) -> None:
    facts = FACTS | {"license": "https://creativecommons.org/licenses/by nc/4.0/"}
    iiif.write(tmp_path, {"one": waves(20, 30)}, facts, "https://example.org/my files/pot #3")
    texts = [(tmp_path / file).read_text() for file in ("manifest.json", "one/info.json")]
    found = [address for text in texts for address in re.findall(r'"(?:id|rights|target)": "([^"]*)"', text)]
    assert "https://example.org/my%20files/pot%20%233/one" in found
    assert len(found) > 8 and not [address for address in found if re.search(r"[ #]", address)]
