"""Training: one command that learns, stops in time, and goes on where it stopped."""

import csv
from pathlib import Path

import cv2
import pytest
import torch

from polcap.errors import InputError
from polcap.training import loop, main_network, muon, onnx_export, train
from polcap.training.simulator import Simulator
from tests.conftest import ROOT
from tests.training.test_main_network import TINY
from tests.training.test_onnx_export import settled

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning", "ignore::UserWarning"
)
PRESET = train.TrainingPreset(TINY, 4, 1, 64, (32, 64), (0.5, 0.5), (0.2, 0.8), 4 * 64**2)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


class Clock:
    """Goes on by a third of a second whenever it is looked at."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        self._now += 0.3
        return self._now


def test_run_stops_in_time_and_resumes(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(train.PRESETS, "cpu", PRESET)
    monkeypatch.setattr(loop, "time", Clock())
    params = train.TrainingOptions(data=data, out=tmp_path, minutes=0.07, threads=1)
    made, last = train.main(params), tmp_path / "last.pt"
    first, facts = train.load_average(last)
    weights, told = onnx_export.read_weights(made)
    assert told["training"].startswith(f"{facts['samples']} samples") and told["version"] == tmp_path.name
    assert all(torch.allclose(w, weights[k], rtol=1e-3, atol=1e-4) for k, w in first.state_dict().items())  # halves
    assert 4.2 <= facts["elapsed"] < 5 and facts["samples"] > facts["step"] > 0
    assert {"step", "loss", "normal", "render"} <= set(rows(tmp_path / "metrics.csv")[0])
    assert float(rows(tmp_path / "watch.csv")[-1]["normal_mean"]) < 90
    panel = cv2.imread(str(tmp_path / "watch.png"))
    assert panel.shape == (8 * 128, 11 * 128, 3) and panel[:, :128].max() > 100  # S0, truth and estimate of five maps

    train.main(train.TrainingOptions(data=data, out=tmp_path, minutes=0.1, threads=1, resume=True))
    second, later = train.load_average(last)
    assert later["step"] > facts["step"] and later["elapsed"] > facts["elapsed"]
    moved = [not torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters())]
    assert any(moved)


def test_training_starts_from_a_shipped_model(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(train.PRESETS, "cpu", PRESET)
    onnx_export.export_main(settled(TINY), tmp_path / "first.onnx", {"training": "10 samples", "licence": "x"})
    weights, _ = onnx_export.read_weights(tmp_path / "first.onnx")
    run = train.NetworkTraining(TINY, torch.device("cpu"), 1e-3)
    run.begin(tmp_path / "first.onnx")
    for network in (run.network, run.average):
        assert all(torch.equal(value, weights[name]) for name, value in network.state_dict().items())
    params = train.TrainingOptions(data=data, out=tmp_path / "out", samples=8, threads=1, start=tmp_path / "first.onnx")
    _, facts = onnx_export.read_weights(train.main(params))
    assert facts["training"].endswith("minutes, after 10 samples")


def test_a_schedule_continues_after_the_pictures_of_the_first_weights(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(train.PRESETS, "cpu", PRESET)
    onnx_export.export_main(settled(TINY), tmp_path / "first.onnx", {"training": "92 samples", "licence": "x"})
    out = tmp_path / "out"
    params = train.TrainingOptions(data=data, out=out, samples=100, done=92, threads=1, start=tmp_path / "first.onnx")
    _, facts = onnx_export.read_weights(train.main(params))
    _, state = train.load_average(out / "last.pt")
    assert 100 <= state["samples"] < 120  # eight pictures are left of a hundred
    assert facts["training"].startswith(f"{state['samples'] - 92} samples")


def test_the_shipped_model_can_start_training() -> None:
    run = train.NetworkTraining(main_network.SMALL, torch.device("cpu"), 1e-3)
    run.begin(ROOT / "calib" / "models" / "polcap.onnx")
    assert run.begun.split()[1] == "samples"


def test_resume_and_start_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give one of them"):
        train.main(train.TrainingOptions(out=tmp_path, resume=True, start=tmp_path / "m.onnx"))


def test_training_cannot_start_from_a_model_of_another_size(tmp_path: Path) -> None:
    onnx_export.export_main(main_network.MainNetwork(TINY), tmp_path / "tiny.onnx", {"licence": "x"})
    with pytest.raises(InputError, match="not a network of this preset"):
        train.NetworkTraining(main_network.SMALL, torch.device("cpu"), 1e-3).begin(tmp_path / "tiny.onnx")


def test_steps_on_one_batch_lower_its_loss(simulator: Simulator) -> None:
    torch.manual_seed(0)
    run, batch = train.NetworkTraining(TINY, torch.device("cpu"), 3e-3, 2), simulator.draw_batch(4, 64)
    run.step = 200  # past the warm-up
    losses = [run.advance([batch, batch], 0.0)["loss"] for _ in range(25)]
    assert losses[-1] < 0.8 * losses[0]


def test_resume_needs_a_checkpoint(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(train.PRESETS, "cpu", PRESET)
    with pytest.raises(InputError, match="nothing to resume"):
        train.main(train.TrainingOptions(data=data, out=tmp_path, resume=True))


def test_a_finished_run_is_not_overwritten(data: Path, tmp_path: Path) -> None:
    train.NetworkTraining(TINY, torch.device("cpu"), 1e-3).save(tmp_path / "last.pt")
    with pytest.raises(InputError, match="continue from it with --resume"):
        train.main(train.TrainingOptions(data=data, out=tmp_path))


def test_a_run_resumes_only_with_its_own_preset_and_variant(tmp_path: Path) -> None:
    train.NetworkTraining(TINY, torch.device("cpu"), 1e-3, variant="published inputs").save(tmp_path / "last.pt")
    for shape, variant in ((TINY, "ours"), (main_network.SMALL, "published inputs")):
        with pytest.raises(InputError, match=r"variant \('published inputs'\); resume it with the same ones"):
            train.NetworkTraining(shape, torch.device("cpu"), 1e-3, variant=variant).load(tmp_path / "last.pt")


def test_data_without_test_meshes_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="meshes/test holds no mesh"):
        train.main(train.TrainingOptions(data=tmp_path, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_same_seed_same_weights(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(train.PRESETS, "cpu", PRESET)
    weights = []
    for name, seed in (("first", 1), ("again", 1), ("other", 2)):
        out = tmp_path / name
        for cache in ("views", "watch"):
            if (tmp_path / "first").exists() and name != "first":
                (out / cache).parent.mkdir(exist_ok=True)
                (out / cache).symlink_to(tmp_path / "first" / cache)
        train.main(train.TrainingOptions(data=data, out=out, samples=40, threads=1, seed=seed))
        weights.append(train.load_average(out / "last.pt")[0].state_dict())
    same, other = ([bool(torch.equal(w, weights[0][k])) for k, w in state.items()] for state in weights[1:])
    assert all(same) and not any(other)


def test_unknown_preset_is_refused() -> None:
    with pytest.raises(InputError, match="'tpu' is not one of cpu, gpu"):
        train.main(train.TrainingOptions(preset="tpu"))


def test_rate_falls_to_nothing_over_the_last_part_of_the_budget(data: Path) -> None:
    from polcap.training.simulator import Batch

    device = torch.device("cpu")
    run = train.NetworkTraining(TINY, device, 1e-3)
    run.step = 1000
    torch.manual_seed(0)
    size = (1, 1, 32, 32)
    batch = Batch(
        channels=torch.rand(1, 14, 32, 32),
        mask=torch.ones(1, 32, 32, dtype=torch.bool),
        normal=torch.nn.functional.normalize(torch.ones(1, 3, 32, 32), dim=1),
        depth=torch.rand(size),
        diffuse=torch.rand(1, 3, 32, 32),
        specular=torch.rand(1, 3, 32, 32),
        roughness=torch.rand(size),
        highlight=torch.rand(size),
        law=torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1).expand(1, 3, 32, 32),
    )
    rates = []
    for progress in (0.1, 0.2, 0.6, 1.0):
        run.advance([batch], progress)
        rates.append(run.optimizers[0].param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3, 1e-3, 5e-4, 0.0])


@pytest.mark.parametrize("shape", [(16, 144), (96, 32), (64, 128)])
def test_orthogonal_keeps_directions_and_levels_strengths(shape: tuple[int, int]) -> None:
    """Against LAPACK's singular value decomposition."""
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(3))
    left, strength, right = torch.linalg.svd(muon.orthogonal(matrix[None])[0], full_matrices=False)
    assert strength.min() > 0.5 and strength.max() < 1.35
    u, _, v = torch.linalg.svd(matrix, full_matrices=False)
    nearest = u @ v
    assert float(((left * strength) @ right * nearest).sum() / nearest.norm() ** 2) > 0.8


def test_every_weight_is_in_one_optimizer() -> None:
    network = main_network.MainNetwork(TINY)
    optimizers = loop.make_optimizers(network, 1e-3)
    held = [w for o in optimizers for g in o.param_groups for w in g["params"]]
    assert sorted(map(id, held)) == sorted(map(id, network.parameters()))
    name = {id(w): name for name, w in network.named_parameters()}
    muon = {name[id(w)] for w in optimizers[0].param_groups[0]["params"]}
    assert {"down.0.weight", "profiles.read.0.weight", "geometry.skip.0.weight"} <= muon
    assert not muon & {"stem.weight", "recolor.knots", "gloss.out.weight", "gloss.raw.weight", "stem.bias"}
