"""The whole chain on small views, `polcap synth --flat --views` and `polcap material`, against the truth."""

import json
import shutil
from pathlib import Path

import bench_material
import pytest

from tests.conftest import ROOT, Command, made_once, python


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Five small views of a flat sample, and its material, as the example makes them."""

    def make(folder: Path) -> None:
        done = python(ROOT / "examples" / "flat_sample.py", folder)
        assert done.returncode == 0 and "texels of 1.1" in done.stdout, done.stderr

    made = made_once(tmp_path_factory, worker_id, "sample", make)
    return Path(shutil.copytree(made, tmp_path_factory.mktemp("flat") / "sample"))  # of this worker alone


def test_five_raw_views_become_a_material_that_is_like_the_true_one(sample: Path) -> None:
    errors = bench_material.errors(sample)
    assert errors["normal"] < 1.5 and errors["flat"] > 2.5  # degrees; of the maps, and of a flat guess
    assert errors["albedo"] < 0.04 and errors["roughness"] < 0.12 and errors["f0"] < 0.01  # five views
    assert errors["height"] < 0.15


def test_maps_state_their_scale_and_light_is_found(sample: Path) -> None:
    about = json.loads((sample / "material" / "report.json").read_text())
    stored = json.loads((sample / "material" / "maps" / "maps.json").read_text())
    truth = json.loads((sample / "truth.json").read_text())
    assert stored["texel_m"] == pytest.approx(0.6 * 2 / truth["focal_px"], rel=0.05)
    assert stored["thickness_m"] == pytest.approx(truth["thickness_m"], abs=0.0004)
    true = [view["light"] / truth["views"][0]["light"] for view in truth["views"]]
    assert [view["light"] for view in about["figures"]["views"].values()] == pytest.approx(true, rel=0.025)
    assert about["figures"]["flash"]["place_m"] == pytest.approx(truth["light"], abs=0.005)


def test_a_run_again_computes_nothing_and_exports_work(sample: Path, polcap: Command) -> None:
    again = polcap("material", sample, "--set", "material.gloss.materials=3")
    assert again.returncode == 0
    assert "Nothing has changed" in again.stderr or "texel_maps    cached" in again.stderr
    assert (sample / "material" / "asset" / "unreal" / "T_sample_N.png").is_file()
    assert polcap("export", sample / "material", "--lod", 2).returncode == 2
    assert polcap("show", sample / "material", "stokes").returncode == 2


def test_a_new_material_names_the_exports_of_the_earlier_one(sample: Path, polcap: Command, tmp_path: Path) -> None:
    folder = tmp_path / "sample"
    shutil.copytree(sample, folder)
    done = polcap("material", folder, "--set", "material.gloss.materials=3", "--tile")
    assert done.returncode == 0 and "asset/unreal in " in done.stderr and "exported earlier" in done.stderr


def test_a_view_without_the_board_is_left_out_and_named(
    sample: Path, example: Path, polcap: Command, tmp_path: Path
) -> None:
    folder = tmp_path / "fewer"
    shutil.copytree(sample, folder)  # with the stages of the other views
    for file in (folder / "view03").glob("pol*/*.DNG"):
        shutil.copy(next((example / file.parent.name).glob("*.DNG")), file)
    done = polcap("material", folder, "--region=-12,-12,12,12", "--set", "material.gloss.materials=1")  # quicker
    assert done.returncode in (0, 2) and "view03: no board is visible" in done.stderr


@pytest.mark.parametrize(
    ("option", "part"),
    [
        (("--region", "1,2,3"), "4 are needed"),
        (("--region", "0,0,500,500"), "must lie within"),
        (("--region", "20,20,-20,-20"), "x0 < x1 and y0 < y1 are needed"),
        (("--texel", "50"), "change --texel or --region"),
        (("--no-chart", "--chart", "a"), "exclude"),
    ],
)
def test_a_wrong_option_is_one_line_with_a_remedy(
    sample: Path, polcap: Command, option: tuple[str, ...], part: str
) -> None:
    refused = polcap("material", sample, *option)
    assert refused.returncode == 2 and part in refused.stderr and len(refused.stderr.strip().splitlines()[-1]) > 20
