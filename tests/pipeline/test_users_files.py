"""A user's files are sacred: no command deletes, replaces or follows a link to what polcap did not write."""

import shutil
from pathlib import Path

import pytest

from tests.campaigns.users_files import sequence
from tests.conftest import TINY, Command


@pytest.fixture
def capture(tiny: Path, tmp_path: Path) -> Path:
    """The tiny capture C with its finished result C/polcap, to be changed."""
    return Path(shutil.copytree(tiny / "C", tmp_path / "C"))


def photographs(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*.DNG")}


@pytest.mark.parametrize("place", ["maps", "work/01-hdr", "asset", "deep/er"])
def test_a_capture_inside_the_result_folder_stays(capture: Path, polcap: Command, tmp_path: Path, place: str) -> None:
    shutil.rmtree(capture / "polcap")
    before = photographs(capture)
    inside = tmp_path / "out" / place
    inside.parent.mkdir(parents=True)
    capture.rename(inside)
    done = polcap("process", inside, "--out", tmp_path / "out", *TINY)
    assert done.returncode == 2 and "contains the capture" in done.stderr
    assert photographs(inside) == before


@pytest.mark.parametrize("listed", [False, True])
def test_a_result_is_refused_among_the_shots_of_any_capture(
    capture: Path, polcap: Command, tmp_path: Path, listed: bool
) -> None:
    other = tmp_path / "other"
    shutil.copytree(capture, other, ignore=shutil.ignore_patterns("polcap"))
    place = other / "pol045"
    if listed:
        place = place.rename(other / "frames")
        file = next(place.iterdir())
        (other / "capture.toml").write_text(f'[[frame]]\nfile = "frames/{file.name}"\nangle = 45\n')
    done = polcap("process", capture, "--out", place / "result", *TINY)
    assert done.returncode == 2 and "lies among the capture's shots" in done.stderr
    assert not (place / "result").exists()


@pytest.mark.parametrize(
    "command",
    [
        "process CAPTURE", "batch CAPTURE", "report RESULT --compare RESULT", "export RESULT", "calibrate CAPTURE",
        "evaluate x.onnx y",
    ],
)  # fmt: skip
def test_no_command_writes_between_photographs(
    result: Path, capture: Path, polcap: Command, tmp_path: Path, command: str
) -> None:
    other = tmp_path / "flat"
    shutil.copytree(capture / "pol045", other)
    before = sorted(other.rglob("*"))
    words = command.replace("RESULT", str(result)).replace("CAPTURE", str(capture)).split()
    done = polcap(*words, "--out", other)
    assert done.returncode == 2 and f"--out {other} holds photographs (" in done.stderr
    assert done.stderr.endswith("choose a folder of its own\n")
    assert sorted(other.rglob("*")) == before


@pytest.mark.parametrize("name", ["maps", "work", "asset", "report.json", "color.toml"])
def test_a_folder_that_holds_parts_of_a_result_without_record_is_refused(
    capture: Path, polcap: Command, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "home"
    (out / name).mkdir(parents=True)
    (out / name / "photograph.dng").write_bytes(b"RAW")
    done = polcap("process", capture, "--out", out, *TINY)
    assert done.returncode == 2 and f"holds {name}" in done.stderr
    assert [path.name for path in out.rglob("*") if path.is_file()] == ["photograph.dng"]


def test_foreign_files_in_a_result_survive_every_command(capture: Path, polcap: Command) -> None:
    result = capture / "polcap"
    places = ("maps/notes.txt", "maps/IMG.DNG", "work/01-hdr/x.npy", "work/10-app/manifest.json", ".bashrc.old",
              ".ssh.old/key", "asset/.C.7.part.glb", "color.toml", "compare.html", "work/light.webp")  # fmt: skip
    for name in places:
        (result / name).parent.mkdir(exist_ok=True)
        (result / name).write_bytes(name.encode())
    for words in (
        ("process", capture, *TINY, "--set", "asset.ior=1.4"), ("export", result, "--obj"), ("report", result),
        ("report", result, "--compare", result), ("show", result, "--animate", "light"), ("clean", result),
        ("process", capture, *TINY, "--force", "hdr"),
    ):  # fmt: skip
        assert polcap(*words).returncode != 1
    assert {name: (result / name).read_bytes() for name in places} == {name: name.encode() for name in places}


@pytest.mark.parametrize("name", ["maps/diffuse.png", "maps/normal.exr", "asset/C.glb", "report.html"])
def test_an_edited_file_of_a_result_stays_and_is_named_at_once(capture: Path, polcap: Command, name: str) -> None:
    edited = capture / "polcap" / name
    edited.write_bytes(content := edited.read_bytes() + b"retouched")
    done = polcap("process", capture, *TINY, "--set", "asset.ior=1.4", "--force", "hdr")
    assert done.returncode == 2 and f"{name}: it was edited" in done.stderr and "hdr" not in done.stderr
    assert polcap("process", capture, *TINY, "--until", "mask", "--force", "hdr").returncode == 0  # replaces no map
    for words in (("export", edited), ("report", capture), ("clean", capture)):
        assert polcap(*words).returncode != 1
    assert edited.read_bytes() == content
    edited.rename(edited.with_name("mine"))
    assert polcap("process", capture, *TINY).returncode in (0, 3) and edited.read_bytes() != content


def test_an_edited_texture_of_a_preset_stays(capture: Path, polcap: Command) -> None:
    assert polcap("export", capture, "--preset", "unreal").returncode == 0
    texture = sorted((capture / "polcap" / "asset" / "unreal").glob("*.png"))[0]
    texture.write_bytes(b"retouched")
    before = {file: file.read_bytes() for file in texture.parent.iterdir()}
    done = polcap("export", capture, "--preset", "unreal", "--about", "title=Vase")
    assert done.returncode == 2 and f"{texture.name}: it was edited" in done.stderr
    assert {file: file.read_bytes() for file in texture.parent.iterdir()} == before
    assert polcap("process", capture, *TINY, "--set", "asset.ior=1.4").returncode in (0, 3)  # replaces no preset's
    assert texture.read_bytes() == b"retouched"


@pytest.mark.parametrize("name", ["maps", "asset", "work", "work/01-hdr", "report.json", "asset/C.glb"])
def test_links_in_a_result_are_not_written_through(capture: Path, polcap: Command, tmp_path: Path, name: str) -> None:
    link, target = capture / "polcap" / name, tmp_path / "elsewhere"
    link.rename(target)
    link.symlink_to(target)
    before = {path: path.read_bytes() for path in [target, *target.rglob("*")] if path.is_file()}
    done = polcap("process", capture, *TINY, "--force", "hdr")
    assert done.returncode == 2 and "is a link" in done.stderr
    polcap("clean", capture)
    assert link.is_symlink() and {path: path.read_bytes() for path in before} == before


def test_a_linked_default_result_is_refused_and_a_named_one_is_used(
    capture: Path, polcap: Command, tmp_path: Path
) -> None:
    target = tmp_path / "disk"
    (capture / "polcap").rename(target)
    (capture / "polcap").symlink_to(target)
    assert "is a link" in polcap("process", capture, *TINY, "--force", "asset").stderr
    (tmp_path / "named").symlink_to(target)
    assert polcap("process", capture, "--out", tmp_path / "named", *TINY, "--force", "asset").returncode in (0, 3)


def test_a_chart_profile_in_the_result_is_used_and_stays(capture: Path, polcap: Command) -> None:
    profile = capture / "polcap" / "color.toml"
    profile.write_text('matrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nsource = "chart"\n')
    for _ in range(2):
        assert polcap("process", capture, "--chart", profile, "--estimator", "analytic").returncode in (0, 3)
        assert profile.read_text().startswith("matrix = [[1")


def test_an_input_that_the_run_would_replace_is_refused(capture: Path, polcap: Command) -> None:
    mask = capture / "polcap" / "maps" / "mask.png"
    before = mask.read_bytes()
    done = polcap("process", capture, "--mask", mask, *TINY)
    assert done.returncode == 2 and "part of the result" in done.stderr
    assert mask.read_bytes() == before


def test_clean_stays_in_the_named_folder(capture: Path, polcap: Command, tmp_path: Path) -> None:
    """Also if the batch.json of a stranger names another tree."""
    batch = tmp_path / "batch" / "polcap-batch"
    batch.mkdir(parents=True)
    (batch / "batch.json").write_text(f'{{"root": "{tmp_path}", "out": null}}')
    done = polcap("clean", batch.parent)
    assert "lies outside" in done.stderr
    assert sorted((capture / "polcap" / "work").rglob("*.npy"))
    assert polcap("clean", tmp_path).returncode == 2


def test_an_existing_file_is_no_log(polcap: Command, tmp_path: Path) -> None:
    file = tmp_path / "IMG.DNG"
    file.write_bytes(b"RAW")
    assert polcap("settings", "hdr", "--log", file).returncode == 2
    assert file.read_bytes() == b"RAW"
    log = tmp_path / "new.log"
    for _ in range(2):
        assert polcap("settings", "hdr", "--log", log).returncode == 0


def test_a_board_replaces_no_file(polcap: Command, tmp_path: Path) -> None:
    (tmp_path / "board-A4.pdf").write_bytes(b"mine")
    assert polcap("board", tmp_path).returncode == 2
    assert (tmp_path / "board-A4.pdf").read_bytes() == b"mine" and not (tmp_path / "board-A4.svg").exists()


@pytest.mark.parametrize("seed", range(4))
def test_random_sequences_of_commands_leave_every_foreign_byte(tiny: Path, seed: int) -> None:
    assert sequence(tiny, seed) == []
