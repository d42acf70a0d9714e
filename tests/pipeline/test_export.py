"""`polcap export`: every preset whole and valid, the same bytes whenever, one line where it cannot."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh

from polcap.formats.export import encoders
from polcap.formats.export.presets import EXTRAS, FORMATS, PRESETS
from polcap.formats.maps import png
from polcap.formats.raw.exif import UPRIGHT_DEG
from polcap.pipeline import asset_export, detail_levels
from polcap.pipeline import run as pipeline
from polcap.pipeline.export_request import ExportRequest
from polcap.report import levels
from polcap.synth import scenes, shooting
from tests.conftest import ROOT, TINY, Command, shell
from tests.formats.export.test_gltf import NODE, document
from tests.stages.hdr import brackets


@pytest.fixture(scope="module")
def exported(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny capture's result with every preset exported."""
    pytest.importorskip("pxr", reason="needs usd-core")
    copy = tmp_path_factory.mktemp("export") / "copy"
    shutil.copytree(tiny / "C" / "polcap", copy, ignore=shutil.ignore_patterns("work"))
    for preset in PRESETS:
        pipeline.export(copy, ExportRequest(preset=preset))
    return copy


@pytest.fixture
def own(result: Path, tmp_path: Path) -> Path:
    """A copy of the small capture's result, because an export locks its folder."""
    copy = tmp_path / "own"
    shutil.copytree(result, copy, ignore=shutil.ignore_patterns("work"))
    return copy


@pytest.mark.parametrize("preset", [name for name, preset in PRESETS.items() if "gltf" in preset.formats])
def test_validator_finds_no_error_and_no_warning(exported: Path, preset: str) -> None:
    node = shutil.which("node")
    if node is None or not (NODE / "node_modules" / "gltf-validator").is_dir():
        pytest.skip("needs node, and `npm ci` in tests/gltf")
    (glb,) = (exported / "asset" / preset).glob("*.glb")
    done = subprocess.run([node, str(NODE / "validate.js"), str(glb)], capture_output=True, check=True, timeout=300)
    issues = json.loads(done.stdout)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


FACTS = {
    "title": "Krug Ω", "creator": "Frieda <F.>", "rights": "© Museum", "object_number": "1897.12",
    "license": "https://creativecommons.org/licenses/by/4.0/", "date": "um 1720", "institution": "Haus Nord",
    "description": "Glasiert, mit Deckel",
}  # fmt: skip
_UNNAMED = re.compile(  # files whose format has no place for facts, or that belong to a file which states them
    r".*\.stl|.*_sfp/(K\.txt|sfp\.mat|.*\.png)|.*_iiif/\w+/(info\.json|full/max/0/default\.jpg)|"
    r"archive/(color\.toml|manifest-sha256\.txt|maps/.*\.(exr|png))"
)


def _stated(file: Path) -> str:
    """The texts that a reader of this format finds in a file: another program's reader, or the rules of the format."""
    kind = file.suffix
    if kind == ".glb":
        return json.dumps(document(file.read_bytes())["extensions"]["KHR_xmp_json_ld"], ensure_ascii=False)
    if kind in (".usdc", ".usdz"):
        return str(pytest.importorskip("pxr.Sdf").Layer.FindOrOpen(str(file)).customLayerData)
    if kind in (".png", ".exr"):
        return "\n".join(str(one.value) for one in oiio.ImageInput.open(str(file)).spec().extra_attribs)
    text = file.read_bytes().decode(errors="replace")
    if kind in (".obj", ".mtl"):
        return "\n".join(line for line in text.splitlines() if line.startswith("#"))
    if kind == ".ply":
        return "\n".join(line for line in text.partition("end_header")[0].splitlines() if line.startswith("comment "))
    if kind == ".mtlx":
        return ElementTree.fromstring(text).attrib["doc"]
    if kind == ".html":
        return unescape(text)
    return json.dumps(json.loads(text), ensure_ascii=False) if kind == ".json" else text


def test_every_file_states_all_facts_for_catalogs(tiny_result: Path, tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="needs usd-core")
    (tmp_path / "viewer.js").write_text("// model-viewer")
    own, formats = tiny_result, tuple(one for one in FORMATS if one != "iiif")
    plain = ExportRequest(formats=formats, extras=("occlusion",), triangles=2000, catalog=FACTS, iiif="http://a.b")
    pipeline.export(
        own,
        replace(plain, page=tmp_path / "viewer.js"),
        *(ExportRequest(preset=preset, triangles=2000, catalog=FACTS) for preset in PRESETS),
    )
    names = [file.relative_to(own / "asset").as_posix() for file in (own / "asset").rglob("*") if file.is_file()]
    named = {name for name in names if not _UNNAMED.fullmatch(name) and not re.match(r".*_iiif/\w+/(full|\d)", name)}
    texts = {name: _stated(own / "asset" / name) for name in sorted(named)}
    assert [(name, key) for name, text in texts.items() for key, fact in FACTS.items() if fact not in text] == []
    assert {Path(name).suffix for name in named} == {
        ".glb", ".obj", ".mtl", ".ply", ".usdc", ".usdz", ".mtlx", ".exr", ".png", ".html", ".json", ".txt",
    }  # fmt: skip
    assert {"archive/maps/maps.json", "C_iiif/manifest.json", "archive/report.html"} < named


@pytest.mark.parametrize("preset", PRESETS)
def test_maps_json_and_the_files_say_what_they_hold(exported: Path, preset: str) -> None:
    stated = json.loads((exported / "maps" / "maps.json").read_text())["exports"][f"asset/{preset}"]
    assert stated["unit"] in ("m", "relative") and "+Y" in stated["for"]
    for name, meaning in stated["textures"].items():
        if name.endswith(".exr"):
            assert meaning == oiio.ImageBuf(str(exported / "asset" / preset / name)).spec()["polcap:meaning"]
            continue
        assert meaning.encode() in (exported / "asset" / preset / name).read_bytes()[:300]


def test_maps_json_and_report_json_agree_and_state_units(exported: Path) -> None:
    stated = json.loads((exported / "maps" / "maps.json").read_text())
    about = json.loads((exported / "report.json").read_text())
    assert about["figures"]["object"]["crop"] == stated["crop"] and about["units"]["object.crop"] == "RAW px"
    assert about["figures"]["maps"]["estimator"] == stated["estimator"]
    assert about["units"]["mesh.extent"] == stated["depth"]["unit"]
    assert about["capture"]["focal_known"] == stated["camera"]["focal_known"]
    assert about["capture"]["focal_px"] == pytest.approx(stated["camera"]["focal_px"] * stated["scale"])


def test_unreal_gets_green_down_and_unity_smoothness(exported: Path) -> None:
    assets = exported / "asset"
    down, up = (png.read(assets / name) for name in ("unreal/T_C_N.png", "unity/C_Normal.png"))
    assert np.array_equal(down[..., 1], 255 - up[..., 1]) and np.array_equal(down[..., ::2], up[..., ::2])
    packed, mask = (png.read(assets / name) for name in ("unreal/T_C_ORM.png", "unity/C_MaskMap.png"))
    assert np.array_equal(mask[..., 3], 255 - packed[..., 1]) and mask[..., 0].max() == 0


def test_an_asset_and_the_textures_beside_it_are_spelled_alike(tiny_result: Path) -> None:
    about = json.loads((tiny_result / "report.json").read_text())
    about["capture"]["name"] = "blue jug 7"
    (tiny_result / "report.json").write_text(json.dumps(about))
    named = {file.name for file in pipeline.export(tiny_result, ExportRequest(preset="unreal", texture_size=64))}
    assert {"SM_blue_jug_7.glb", "T_blue_jug_7_N.png"} <= named and not any(" " in name for name in named)


def test_archived_textures_have_16_bits(exported: Path) -> None:
    pictures = list((exported / "asset" / "archive").glob("*.png"))
    assert pictures and all(png.read(file).dtype == np.uint16 for file in pictures)


def test_sidecar_knows_photographs_settings_and_files(exported: Path) -> None:
    recorded = json.loads((exported / "asset" / "archive" / "C.provenance.json").read_text())
    about = json.loads((exported / "report.json").read_text())
    assert [one["sha256"] for one in recorded["photographs"]] == [
        frame["digest"] for shot in about["capture"]["shots"] for frame in shot["frames"]
    ]
    assert recorded["settings"] == about["settings"] and recorded["stages"] == about["keys"]
    assert recorded["versions"]["polcap"] == about["polcap"] and "numpy" in recorded["versions"]
    files = {file.name for file in (exported / "asset" / "archive").iterdir()}
    assert files - {"C.provenance.json", "manifest-sha256.txt", "maps"} <= set(recorded["files"])
    metadata = document((exported / "asset/archive/C.glb").read_bytes())["extensions"]["KHR_xmp_json_ld"]
    assert json.loads(metadata["packets"][0]["polcap:settings"]) == about["settings"]


def test_exporting_again_gives_the_bytes_that_process_wrote(tiny: Path, tiny_result: Path, polcap: Command) -> None:
    before = {file.name: file.read_bytes() for file in (tiny_result / "asset").iterdir()}
    shutil.rmtree(tiny_result / "asset")
    cv2.setNumThreads(1)
    try:
        assert polcap("export", tiny_result).returncode == 0
    finally:
        cv2.setNumThreads(-1)
    assert {file.name: file.read_bytes() for file in (tiny_result / "asset").iterdir()} == before
    assert (tiny_result / "maps/maps.json").read_bytes() == (tiny / "C/polcap/maps/maps.json").read_bytes()


def test_a_wrong_name_makes_no_copy(tiny_result: Path, polcap: Command, tmp_path: Path) -> None:
    for wrong in (("--preset", "unrael"), ("--extra", "oclusion"), ("--about", "titel=Vase")):
        assert polcap("export", tiny_result, *wrong, "--out", tmp_path / "new").returncode == 2
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "3ds"], f"--preset 3ds: there is no such preset; there are {', '.join(PRESETS)}"),
        (["--preset", "unrael"], "--preset unrael: there is no such preset; did you mean unreal?"),
        (["--preset", "unity,godot"], "repeat the option: --preset unity --preset godot"),
        (["--extra", "cavity, occlusion"], "repeat the option: --extra cavity --extra occlusion"),
        (["--extra", "oclusion"], "--extra oclusion: there is no such texture; did you mean occlusion?"),
        (["--about", "titel=Vase"], "--about titel: there is no such fact; did you mean title?"),
        (["--preset", "web", "--obj"], "write obj by a second export"),
        (["--preset", "maya", "--color", "ACEScg"], "converts the colors of the layered EXR only"),
        (["--obj", "--geometry", "draco"], "change the GLB, which is not written"),
        (["--preset", "web", "--bits", "16"], "--bits 16 is for PNG textures, and none is written; add --images png"),
        (["--ply", "--bits", "16"], "--bits 16 is for PNG textures"),
        (["--about", "title"], "--about title: write FACT=TEXT"),
        (["--about", "by=me"], "--about by: there is no such fact; there are title, creator"),
        (["--obj", "--page", ROOT / "README.md"], "README.md is not model-viewer"),
        (["--iiif", "museum.example/7"], "--iiif museum.example/7 is no web address"),
        (["--iiif", "http://museum.example/7", "--texture-size", "512"], "leave out --texture-size"),
        (["--iiif", "http://museum.example/7", "--preset", "unity"], "and presets for engines"),
        (["--exr", "--color", "ACEScq"], "--color ACEScq is not a color space or role"),
    ],
)
def test_what_does_not_exist_is_one_line(tiny_result: Path, polcap: Command, flags: list[str], words: str) -> None:
    done = polcap("export", tiny_result, *flags)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr


def test_relightable_layer_has_the_facts_of_the_catalog_and_is_in_the_sidecar(
    tiny_result: Path, polcap: Command
) -> None:
    facts = ("--about", "title=Vase", "--about", "creator=A. B.")
    done = polcap("export", tiny_result, "--iiif", "http://localhost:8000/", *facts)
    assert done.returncode == 0, done.stderr
    manifest = json.loads((tiny_result / "asset/C_iiif/manifest.json").read_text())
    assert manifest["id"] == "http://localhost:8000/manifest.json" and manifest["label"] == {"none": ["Vase"]}
    assert [one["value"] for one in manifest["metadata"]] == [{"none": ["A. B."]}]
    files = json.loads((tiny_result / "asset/C.provenance.json").read_text())["files"]
    written = {Path(line).relative_to(tiny_result / "asset").as_posix() for line in done.stdout.splitlines()}
    assert written - {"C.provenance.json"} <= set(files)
    names = ("albedo", "specular", "normal", "gloss")
    sizes = {cv2.imread(str(tiny_result / f"asset/C_iiif/{name}/full/max/0/default.jpg")).shape[:2] for name in names}
    assert len(sizes) == 1 and {f"C_iiif/{name}/full/max/0/default.jpg" for name in names} <= written


def test_a_page_for_visitors_states_number_maker_and_rights(tiny_result: Path, polcap: Command, tmp_path: Path) -> None:
    (tmp_path / "viewer.js").write_text("// model-viewer")
    facts = {"title": "Vase", "object_number": "18<97", "creator": "A. B.", "rights": "© House"}
    stated = [part for key, text in facts.items() for part in ("--about", f"{key}={text}")]
    done = polcap("export", tiny_result, "--preset", "web", "--page", tmp_path / "viewer.js", *stated)
    assert done.returncode == 0, done.stderr
    assert "<p>Vase · 18&lt;97 · A. B. · © House</p>" in (tiny_result / "asset/web/C.html").read_text()


def test_ktx2_needs_an_encoder_and_says_so(tiny_result: Path, polcap: Command) -> None:
    if encoders.ktx2_encoder() is not None:
        pytest.skip("an encoder is here")
    done = polcap("export", tiny_result, "--gltf", "--images", "ktx2")
    assert done.returncode == 2 and "ktx" in done.stderr and done.stderr.count("\n") == 1


def test_encoder_on_the_path_makes_ktx2_textures(
    tiny_result: Path, polcap: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stand-in for `toktx` keeps its arguments and writes KTX2's identifier: the way there, not the compression."""
    encoder = tmp_path / "bin" / "toktx"
    encoder.parent.mkdir()
    encoder.write_text(
        '#!/bin/sh\necho "$@" >> "$0.log"\nfor last; do before=$out; out=$last; done\n'
        "printf '\\253KTX 20\\273\\r\\n\\032\\n' > \"$before\"\n"
    )
    encoder.chmod(0o755)
    monkeypatch.setenv("PATH", f"{encoder.parent}:{os.environ['PATH']}")
    monkeypatch.delitem(encoders._KTX2, "ktx")
    done = polcap("export", tiny_result, "--gltf", "--images", "ktx2")
    assert done.returncode == 0, done.stderr
    written = document((tiny_result / "asset" / "C.glb").read_bytes())
    assert written["extensionsRequired"] == ["KHR_texture_basisu"]
    assert {image["mimeType"] for image in written["images"]} == {"image/ktx2"}
    assert all("KHR_texture_basisu" in texture["extensions"] for texture in written["textures"])
    calls = Path(f"{encoder}.log").read_text().splitlines()
    assert sorted("--assign_oetf srgb" in call for call in calls) == [False, False, True, True]  # data, colours


def test_the_example_of_presets_runs(tiny_result: Path, run_example: Callable[..., str]) -> None:
    assert "T_C_N.png: tangent-space normal n * 0.5 + 0.5, -Y" in run_example("export_presets.py", tiny_result)


def test_usd_without_its_package_is_one_line_with_the_remedy(
    tiny_result: Path, polcap: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    done = polcap("export", tiny_result, "--usd")
    assert done.returncode == 2 and "pip install 'polcap[usd]'" in done.stderr and done.stderr.count("\n") == 1


def test_number_of_threads_changes_no_byte(polcap: Command, tmp_path: Path) -> None:
    """This process uses one thread, the other two; the network's own threads are tested in stages/test_golden.py."""
    capture, one, two = (tmp_path / name for name in ("C", "one", "two"))
    shoot = shooting.Shoot(seed=1, width=512, height=384, samples=1, exposures=2)  # two blocks of rows
    shooting.write(capture, scenes.random_scene(1, "bumps"), shoot)
    assert polcap("process", capture, "--out", one, *TINY).returncode in (0, 3)
    assert shell("process", capture, "--out", two, *TINY, "--threads", 2).returncode in (0, 3)
    found = []
    for out in (one, two):
        found.append({file.name: file.read_bytes() for part in ("maps", "asset") for file in (out / part).iterdir()})
        found[-1] |= {str(file.relative_to(out)): file.read_bytes() for file in (out / "work").rglob("*.npy")}
    assert [name for name in found[0] if found[0][name] != found[1][name]] == [] and found[0].keys() == found[1].keys()


@pytest.mark.parametrize("preset", ["unreal", "unity", "godot"])
def test_textures_for_engines_have_powers_of_two(exported: Path, preset: str) -> None:
    sizes = [png.read(file).shape[:2] for file in (exported / "asset" / preset).glob("*.png")]
    assert sizes and all(side & (side - 1) == 0 for size in sizes for side in size)
    stated = json.loads((exported / "maps" / "maps.json").read_text())["size"]
    assert all(0.84 * stated[0] <= width for _, width in sizes)


def test_a_preset_for_an_engine_has_20_000_triangles_unless_stated(own: Path, polcap: Command) -> None:
    done = polcap("export", own, "--preset", "unity", "--texture-size", 64)
    count = json.loads((own / "maps" / "maps.json").read_text())["exports"]["asset/unity"]["mesh"]["triangles"]
    assert 19_000 < count <= 20_000
    said = f"asset/unity has {count:,} triangles; 99 % of the full mesh are within 0."
    assert said in done.stderr and "--triangles N changes" in done.stderr
    all_triangles = ("--triangles", 1_000_000, "--texture-size", 64)
    assert polcap("export", own, "--preset", "unity", *all_triangles).stderr == ""
    assert trimesh.load(own / "asset/unity/capture.glb", force="mesh").faces.shape[0] > 100_000


def test_textures_of_an_engine_that_are_no_power_of_two_are_reported(tiny_result: Path, polcap: Command) -> None:
    odd = polcap("export", tiny_result, "--preset", "unity", "--preset", "web", "--texture-size", 50)
    assert "--texture-size 50 is no power of two, as unity compresses and mipmaps it; use 64" in odd.stderr
    for arguments in (("--preset", "unity", "--texture-size", 64), ("--preset", "web", "--texture-size", 50)):
        assert "power of two" not in polcap("export", tiny_result, *arguments).stderr


def test_larger_textures_than_the_maps_hold_are_reported(tiny_result: Path, polcap: Command) -> None:
    size = max(json.loads((tiny_result / "maps" / "maps.json").read_text())["size"])
    done = polcap("export", tiny_result, "--gltf", "--texture-size", 4 * size)
    assert f"4 times as wide as the maps ({size} px)" in done.stderr and "hdr.demosaic=full" in done.stderr


def test_levels_have_a_quarter_of_triangles_and_texels_and_one_origin(own: Path) -> None:
    pipeline.export(own, ExportRequest(formats=("gltf",), texture_size=256, lod=2))
    notes = json.loads((own / "maps" / "maps.json").read_text())["exports"]["asset"]["lods"]
    glbs = [document((own / "asset" / name).read_bytes()) for name in notes]
    counts = [glb["accessors"][glb["meshes"][0]["primitives"][0]["indices"]]["count"] // 3 for glb in glbs]
    assert counts == [one["triangles"] for one in notes.values()]
    assert counts[1] == pytest.approx(counts[0] / 4, rel=0.1) and counts[2] == pytest.approx(counts[0] / 16, rel=0.1)
    assert len({tuple(glb["asset"]["extras"]["origin_in_camera"]) for glb in glbs}) == 1
    heights = [one["screen_px"] for one in notes.values()]
    assert heights[0] is None and heights[1] > 1.5 * heights[2]
    assert [one["bytes"] for one in notes.values()] == [(own / "asset" / name).stat().st_size for name in notes]


def test_all_levels_together_are_at_most_half_again_as_large_as_the_first(own: Path) -> None:
    files = pipeline.export(own, ExportRequest(formats=("gltf",), lod=3))
    sizes = [file.stat().st_size for file in files if file.suffix == ".glb"]
    assert len(sizes) == 4 and sum(sizes) <= 1.5 * sizes[0]


def test_a_level_off_by_over_one_percent_of_the_size_is_not_written(own: Path, polcap: Command) -> None:
    done = polcap("export", own, "--gltf", "--lod", 6, "--texture-size", 64)
    assert done.returncode == 0 and "levels of --lod would differ by over 1 % of the size" in done.stderr
    written = [trimesh.load(file, force="mesh", skip_materials=True) for file in sorted((own / "asset").glob("*.glb"))]
    size = written[0].extents.max()
    assert 2 < len(written) < 7
    for level in written[1:]:
        assert np.abs(level.bounds - written[0].bounds).max() <= 0.0101 * size


@pytest.fixture
def leveled(tiny_result: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the tiny result, of which levels of any error are written."""
    monkeypatch.setattr(detail_levels, "_LARGEST_DEVIATION", 1.0)
    return tiny_result


def test_a_later_export_of_the_glb_removes_levels_that_polcap_wrote(leveled: Path) -> None:
    own, asset = leveled, leveled / "asset"
    pipeline.export(own, ExportRequest(formats=("gltf",), lod=2), ExportRequest(preset="web", lod=1))
    (asset / "mine_lod2.glb").write_bytes(b"of the user")
    (asset / "C_lod9.glb").write_bytes(b"of the user")
    pipeline.export(own, ExportRequest(formats=("obj",)))
    assert (asset / "C_lod2.glb").exists() and len(levels.rows(own)) == 5
    pipeline.export(own, ExportRequest(formats=("gltf",), lod=1))
    left = sorted(file.name for file in asset.glob("*_lod*"))
    assert left == ["C_lod1.glb", "C_lod9.glb", "mine_lod2.glb"]
    assert (asset / "web" / "C_lod1.glb").exists() and len(levels.rows(own)) == 4
    pipeline.export(own, ExportRequest(formats=("gltf",)))
    assert not (asset / "C_lod1.glb").exists() and len(levels.rows(own)) == 2
    listed = json.loads((asset / "C.provenance.json").read_text())["files"]
    assert all((asset / name).exists() for name in listed)


def test_the_report_lists_the_levels(leveled: Path) -> None:
    pipeline.export(leveled, ExportRequest(formats=("gltf",), lod=1))
    rows = levels.rows(leveled)
    assert [row[0] for row in rows] == ["asset/C.glb", "asset/C_lod1.glb"]
    assert rows[1][4].endswith(" px") and rows[1][2].endswith(" MB")


def test_exports_of_earlier_maps_are_named(leveled: Path, polcap: Command) -> None:
    own = leveled
    first = polcap("export", own, "--preset", "unreal", "--triangles", 999, "--lod", 2, "--texture-size", 32)
    assert first.stderr == ""
    polcap("export", own, "--sfp")
    asset, about = own / "asset", json.loads((own / "report.json").read_text())
    assert asset_export.find_outdated(own, asset_export.sidecars(own), about["keys"]) == []
    about["keys"]["surface"] = "of other maps"
    (own / "report.json").write_text(json.dumps(about))
    maps = json.loads((own / "maps" / "maps.json").read_text())
    (own / "maps" / "maps.json").write_text(json.dumps({**maps, "keys": about["keys"]}))
    old = asset_export.find_outdated(own, asset_export.sidecars(own), about["keys"])
    assert {asset / "C.glb", asset / "C_sfp", asset / "unreal"} < set(old) and asset not in old
    (asset / "mine.png").write_bytes(b"of the user")
    again = polcap("export", own, "--gltf", "--texture-size", 64)
    named = "asset/C.mtl, asset/C.obj, asset/C_basecolor.png, asset/C_normal.exr, "
    assert again.returncode == 0 and named in again.stderr and "mine.png" not in again.stderr
    found = asset_export.find_outdated(own, asset_export.sidecars(own), about["keys"])
    assert asset / "C_sfp" in found and asset / "unreal" in found


def test_presets_of_one_command_each_get_their_folder(tiny_result: Path, polcap: Command) -> None:
    assert polcap("export", tiny_result, "--preset", "web", "--preset", "unreal", "--triangles", 300).returncode == 0
    stated = json.loads((tiny_result / "maps" / "maps.json").read_text())["exports"]
    for preset in ("web", "unreal"):
        assert stated[f"asset/{preset}"]["mesh"]["triangles"] == pytest.approx(300, rel=0.01)
    assert "KHR_mesh_quantization" in document((tiny_result / "asset/web/C.glb").read_bytes())["extensionsRequired"]


def check_sums(archive: Path) -> list[str]:
    """The files that the manifest of an archive lists; it must be right for each, and list all others."""
    listed = {}
    for line in (archive / "manifest-sha256.txt").read_text().splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((archive / name).read_bytes()).hexdigest() == digest
        listed[name] = digest
    files = {file.relative_to(archive).as_posix() for file in archive.rglob("*") if file.is_file()}
    assert set(listed) == files - {"manifest-sha256.txt"}
    return list(listed)


def test_the_report_of_an_archive_states_its_facts_and_links_its_files(
    tiny_result: Path, polcap: Command, tmp_path: Path
) -> None:
    pytest.importorskip("pxr", reason="needs usd-core")
    for title in ("Bowl", "Vase & <lid>"):
        done = polcap("export", tiny_result, "--preset", "archive", "--about", f"title={title}")
        assert done.returncode == 0, done.stderr
    archive = tiny_result / "asset" / "archive"
    page = (archive / "report.html").read_text(encoding="utf-8")
    assert "<b>Vase &amp; &lt;lid&gt;</b>" in page and "Bowl" not in page and '<a href="C.glb">C.glb</a>' in page
    assert json.loads((archive / "report.json").read_text())["capture"]["catalog"] == {"title": "Vase & <lid>"}
    assert "Vase" not in (tiny_result / "report.html").read_text(encoding="utf-8")
    for content, fault in ((b"\xff", "cannot be read"), (b"notes", "has no part catalog"), (None, "is a link")):
        if content is None:
            (tiny_result / "report.html").unlink()
            (tiny_result / "report.html").symlink_to(tmp_path / "notes")
        else:
            (tiny_result / "report.html").write_bytes(content)
        refused = polcap("export", tiny_result, "--preset", "archive")
        assert refused.returncode == 2 and "report.html" in refused.stderr and fault in refused.stderr


def test_an_archive_checks_itself_after_two_exports_and_a_copy(
    tiny_result: Path, polcap: Command, tmp_path: Path
) -> None:
    pytest.importorskip("pxr", reason="needs usd-core")
    to_archive = ("export", tiny_result, "--preset", "archive", "--about", "title=Vase")
    first = polcap(*to_archive, "--iiif", "https://museum.example/7")
    assert first.returncode == 0, first.stderr
    names = check_sums(tiny_result / "asset/archive")
    assert {"maps/normal.exr", "maps/maps.json", "report.html", "report.json", "C.glb"} <= set(names)
    assert "C_iiif/manifest.json" in names and len([name for name in names if name.endswith("default.jpg")]) > 8
    assert ("color.toml" in names) == (tiny_result / "color.toml").exists()
    second = polcap(*to_archive, "--extra", "occlusion")
    assert second.returncode == 0 and second.stderr == ""
    shutil.copytree(tiny_result / "asset/archive", tmp_path / "elsewhere")
    again = polcap("export", tmp_path / "elsewhere", "--out", tmp_path / "new", "--ply")
    assert again.returncode == 0 and (tmp_path / "new/asset/C.ply").exists()
    assert json.loads((tmp_path / "new/asset/C.provenance.json").read_text())["title"] == "Vase"
    third = polcap("export", tmp_path / "elsewhere", "--out", tmp_path / "third", "--preset", "archive")
    assert third.returncode == 0, third.stderr
    assert set(names) - set(check_sums(tmp_path / "third/asset/archive")) == {one for one in names if "_iiif/" in one}
    assert 'href="asset/C.glb"' in (tmp_path / "third/report.html").read_text("utf-8")
    assert 'href="C.glb"' in (tmp_path / "third/asset/archive/report.html").read_text("utf-8")
    for name, *rest in (["status"], ["report"], ["show", "--all"]):
        done = polcap(name, tmp_path / "elsewhere", *rest)
        assert done.returncode == 2 and "is an archive, which holds no stage cache" in done.stderr
    for name, *rest in (["export"], ["report", "--compare", str(tiny_result)]):
        done = polcap(name, tmp_path / "elsewhere", *rest)
        assert done.returncode == 2 and "is an archive, which stays as it is" in done.stderr
    assert set(check_sums(tmp_path / "elsewhere")) == {*names, "C_occlusion.png"}
    (tmp_path / "elsewhere/maps/mask.png").write_bytes((tmp_path / "elsewhere/maps/normal.png").read_bytes())
    altered = polcap("export", tmp_path / "elsewhere", "--out", tmp_path / "newer", "--ply")
    assert "maps/mask.png in" in altered.stderr and "not as in manifest-sha256.txt" in altered.stderr
    shutil.copy(tiny_result / "maps/mask.png", tmp_path / "elsewhere/maps/mask.png")
    if program := shutil.which("sha256sum"):
        command = [program, "-c", "--quiet", "manifest-sha256.txt"]
        assert subprocess.run(command, cwd=tmp_path / "elsewhere", capture_output=True).returncode == 0


@pytest.mark.parametrize("place", ["F/new", "link/new", "C/pol000/new"])
def test_a_copied_result_lies_outside_the_result_and_the_shots(
    tiny_result: Path, polcap: Command, tmp_path: Path, place: str
) -> None:
    shutil.copytree(tiny_result, tmp_path / "F")
    (tmp_path / "link").symlink_to(tmp_path / "F" / "maps", target_is_directory=True)
    (tmp_path / "C" / "pol000").mkdir(parents=True)
    (tmp_path / "C" / "pol000" / "IMG_1.DNG").write_bytes(b"II*\0")
    before = sorted(tmp_path.rglob("*"))
    refused = polcap("export", tmp_path / "F", "--out", tmp_path / place)
    assert refused.returncode == 2 and refused.stderr.count("\n") == 1 and " lies " in refused.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_extra_textures_and_sixteen_bits(tiny_result: Path, polcap: Command) -> None:
    """Displacement is depth.png turned round; object-space normals are the maps'; the GLB holds the occlusion."""
    named = [part for name in EXTRAS for part in ("--extra", name)]
    assert polcap("export", tiny_result, "--obj", "--gltf", "--bits", 16, *named).returncode == 0
    pictures = {name: png.read(tiny_result / "asset" / f"C_{name}.png") for name in ("displacement", "objectnormal")}
    mask = png.read(tiny_result / "maps" / "mask.png") > 127
    depth, normal = (png.read(tiny_result / "maps" / f"{name}.png").astype(int) for name in ("depth", "normal"))
    assert np.abs(pictures["displacement"][mask] - (65535 - depth[mask])).max() <= 2
    assert np.abs(pictures["objectnormal"][mask] - normal[mask]).max() <= 2
    assert png.read(tiny_result / "asset" / "C_basecolor.png").dtype == np.uint16
    occlusion = png.read(tiny_result / "asset" / "C_occlusion.png")[mask] / 65535
    assert 0.5 < occlusion.mean() < 1 and occlusion.min() < 0.9
    material = document((tiny_result / "asset/C.glb").read_bytes())["materials"][0]
    assert material["occlusionTexture"] == {"index": 1}
    stated = json.loads((tiny_result / "maps" / "maps.json").read_text())["exports"]["asset"]["glb"]
    assert stated["C_orm"].startswith("R ambient occlusion, G")


@pytest.mark.parametrize(("orientation", "up"), [(6, (-1, 0)), (8, (1, 0)), (3, (0, -1))])
def test_an_asset_of_a_turned_camera_stands_upright(tiny_result: Path, orientation: int, up: tuple[int, int]) -> None:
    """EXIF 2.3: with Orientation 6 the left side of the stored picture is the top; `up` points to it."""
    own = tiny_result
    lying = trimesh.load(pipeline.export(own, ExportRequest())[0], force="mesh", process=False)
    about = json.loads((own / "report.json").read_text())
    about["capture"]["upright_deg"] = UPRIGHT_DEG[orientation]
    (own / "report.json").write_text(json.dumps(about))
    upright = trimesh.load(pipeline.export(own, ExportRequest())[0], force="mesh", process=False)
    assert upright.vertices[:, 1] == pytest.approx(lying.vertices[:, :2] @ up, abs=1e-6)
    assert upright.vertex_normals[:, 1] == pytest.approx(lying.vertex_normals[:, :2] @ up, abs=1e-4)
    assert upright.vertices[:, 2] == pytest.approx(lying.vertices[:, 2], abs=1e-6)
    assert np.array_equal(upright.visual.uv, lying.visual.uv)


def test_photographs_that_state_different_orientations_turn_nothing() -> None:
    upright, lying = (brackets.frame(None, upright_deg=turn) for turn in (90, 0))
    assert brackets.capture([upright, upright], [upright, upright]).upright_deg == 90
    assert brackets.capture([upright, upright], [upright, lying]).upright_deg == 0


def test_cavities_are_the_concave_part_of_the_curvature(tiny_result: Path) -> None:
    pipeline.export(tiny_result, ExportRequest(formats=("gltf",), extras=("curvature", "cavity")))
    curvature, cavity = (png.read(tiny_result / f"asset/C_{name}.png").astype(int) for name in ("curvature", "cavity"))
    mask = png.read(tiny_result / "maps" / "mask.png") > 127
    assert np.array_equal(cavity, np.minimum(2 * curvature, 65535))
    assert 0.45 < np.median(curvature[mask]) / 65535 < 0.6 and (curvature[~mask] == 32768).all()


def test_a_second_export_adds_to_the_records_of_the_first(tiny_result: Path) -> None:
    """`process` wrote GLB and OBJ; the sidecar and maps.json list them after an export of the EXR too."""
    sidecar = tiny_result / "asset" / "C.provenance.json"
    before = json.loads(sidecar.read_text())["files"]
    pipeline.export(tiny_result, ExportRequest(formats=("exr",)))
    after = json.loads(sidecar.read_text())["files"]
    assert set(after) == {*before, "C_layers.exr"} and after["C.obj"] == before["C.obj"]
    stated = json.loads((tiny_result / "maps" / "maps.json").read_text())["exports"]["asset"]
    assert {"C_basecolor", "C_normal"} <= set(stated["glb"]) and "C_roughness.png" in stated["textures"]


def test_a_sidecar_of_other_maps_is_replaced(tiny_result: Path) -> None:
    sidecar = tiny_result / "asset" / "C.provenance.json"
    recorded = json.loads(sidecar.read_text())
    sidecar.write_text(json.dumps({**recorded, "stages": {}}))
    pipeline.export(tiny_result, ExportRequest(formats=("exr",)))
    assert set(json.loads(sidecar.read_text())["files"]) == {"C_layers.exr"}
