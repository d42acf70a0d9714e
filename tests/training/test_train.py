"""Training: one command that learns, stops in time, and continues from its checkpoint."""

import csv
from pathlib import Path

import cv2
import pytest
import torch

from polcap.errors import InputError, StorageError
from polcap.training import loop, main_network, muon, onnx_export, train
from polcap.training.simulator import Simulator
from tests.conftest import ROOT
from tests.training.conftest import EXPORT_WARNINGS
from tests.training.test_main_network import TINY
from tests.training.test_onnx_export import settled

pytestmark = EXPORT_WARNINGS
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """The preset "cpu" with a tiny network and few views."""
    preset = train.TrainingPreset(TINY, 4, 1, 1, 64, (32, 64), (0.5, 0.5), (0.2, 0.8), 4 * 64**2)
    monkeypatch.setitem(train.PRESETS, "cpu", preset)


class Clock:
    """A clock that advances by 0.3 s at each reading."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        self._now += 0.3
        return self._now


def test_run_stops_in_time_and_resumes(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "time", Clock())
    lines: list[str] = []
    options = train.TrainingOptions(data=data, out=tmp_path, minutes=0.07, threads=1, licence="CC-BY-4.0")
    made = train.main(options, lines.append)
    assert lines[0].startswith("tracing ") and lines[-1].startswith("100 %, step ") and lines[-1].endswith("0 min left")
    assert any(line.startswith("30 %") or "step 1," in line for line in lines)  # after the first step
    first, facts = train.load_average(tmp_path / "last.pt")
    weights, metadata = onnx_export.read_weights(made)
    assert metadata["training"].startswith(f"{facts['samples']} samples") and metadata["version"] == tmp_path.name
    assert metadata["licence"] == "CC-BY-4.0"
    assert all(torch.allclose(w, weights[k], rtol=1e-3, atol=1e-4) for k, w in first.state_dict().items())  # halves
    assert 4.2 <= facts["elapsed"] < 5 and facts["samples"] > facts["step"] > 0
    metrics, watched = (list(csv.DictReader((tmp_path / f"{name}.csv").open())) for name in ("metrics", "watch"))
    assert {"step", "loss", "normal", "render"} <= set(metrics[0]) and float(watched[-1]["normal_mean"]) < 90
    panel = cv2.imread(str(tmp_path / "watch.png"))
    assert panel.shape == (8 * 128, 11 * 128, 3) and panel[:, :128].max() > 100  # S0, truth and estimate of five maps

    again = train.main(train.TrainingOptions(data=data, out=tmp_path, minutes=0.1, threads=1, resume=True))
    assert onnx_export.read_weights(again)[1]["licence"] == "NOASSERTION"  # nobody stated it
    second, later = train.load_average(tmp_path / "last.pt")
    assert later["step"] > facts["step"] and later["elapsed"] > facts["elapsed"]
    assert any(not torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters()))


def test_training_starts_from_a_model_and_continues_its_schedule(data: Path, tmp_path: Path) -> None:
    model = tmp_path / "first.onnx"
    onnx_export.export_main(settled(TINY), model, {"training": "92 samples", "licence": "x"})
    weights, _ = onnx_export.read_weights(model)
    run = train.NetworkTraining(TINY, CPU, 1e-3)
    run.begin(model)
    for network in (run.network, run.average):
        assert all(torch.equal(value, weights[name]) for name, value in network.state_dict().items())
    params = train.TrainingOptions(data=data, out=tmp_path / "out", samples=100, done=92, threads=1, start=model)
    _, facts = onnx_export.read_weights(train.main(params))
    _, state = train.load_average(tmp_path / "out" / "last.pt")
    assert 100 <= state["samples"] < 120  # eight pictures are left of a hundred
    assert facts["training"].startswith(f"{state['samples'] - 92} samples")
    assert facts["training"].endswith("minutes, after 92 samples")
    with pytest.raises(InputError, match="not a network of this preset"):
        train.NetworkTraining(main_network.SMALL, CPU, 1e-3).begin(model)


def test_the_shipped_model_can_start_training() -> None:
    run = train.NetworkTraining(main_network.SMALL, CPU, 1e-3)
    run.begin(ROOT / "calib" / "models" / "polcap.onnx")
    assert run.begun.split()[1] == "samples"


def test_steps_on_one_batch_lower_its_loss(simulator: Simulator) -> None:
    run, batch = train.NetworkTraining(TINY, CPU, 3e-3, 2), simulator.draw_batch(4, 64)
    run.step = 200  # past the warm-up
    losses = [run.advance([batch, batch], 0.0)["loss"] for _ in range(25)]
    assert losses[-1] < 0.8 * losses[0]


def test_rate_falls_to_zero_over_the_last_part_of_the_budget(simulator: Simulator) -> None:
    run, batch = train.NetworkTraining(TINY, CPU, 1e-3), simulator.draw_batch(1, 32)
    run.step, rates = 1000, []
    for progress in (0.1, 0.2, 0.6, 1.0):
        run.advance([batch], progress)
        rates.append(run.optimizers[0].param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3, 1e-3, 5e-4, 0.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "tpu"}, "'tpu' is not one of cpu, gpu"),
        ({"resume": True, "start": Path("m.onnx")}, "give one of them"),
        ({"resume": True}, "nothing to resume"),
        ({"licence": " "}, "--license is empty"),
        ({"data": Path("nowhere")}, "meshes/test holds no mesh"),
    ],
)
def test_impossible_options_are_refused_before_anything_is_made(
    data: Path, tmp_path: Path, options: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        train.main(train.TrainingOptions(**{"data": data, "out": tmp_path / "out", **options}))  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_a_data_set_of_pictures_is_refused_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(InputError, match=r"data set of `polcap synth --dataset`.*give a folder with meshes"):
        train.main(train.TrainingOptions(data=tmp_path, out=tmp_path / "out"))


def test_a_run_is_not_overwritten_and_resumes_only_with_its_own_preset_and_variant(data: Path, tmp_path: Path) -> None:
    train.NetworkTraining(TINY, CPU, 1e-3, variant="published inputs").save(tmp_path / "last.pt")
    with pytest.raises(InputError, match="continue from it with --resume"):
        train.main(train.TrainingOptions(data=data, out=tmp_path))
    for shape, variant in ((TINY, "ours"), (main_network.SMALL, "published inputs")):
        with pytest.raises(InputError, match=r"variant \('published inputs'\); resume it with the same ones"):
            train.NetworkTraining(shape, CPU, 1e-3, variant=variant).load(tmp_path / "last.pt")


@pytest.mark.parametrize("name", ["model.onnx", "metrics.csv", "views"])
def test_a_run_into_a_folder_with_such_a_file_of_others_is_refused(data: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(StorageError, match=f"holds {name}.*choose another --out"):
        train.main(train.TrainingOptions(data=data, out=tmp_path))
    assert (tmp_path / name).read_bytes() == b"mine"


def test_same_seed_same_weights(data: Path, tmp_path: Path) -> None:
    weights: list[dict[str, torch.Tensor]] = []
    for name, seed in (("first", 1), ("again", 1), ("other", 2)):
        out = tmp_path / name
        train.main(
            train.TrainingOptions(data=data, out=out, samples=40, threads=1, seed=seed, traced=tmp_path / "views")
        )
        weights.append(train.load_average(out / "last.pt")[0].state_dict())
    same, other = ([bool(torch.equal(w, weights[0][k])) for k, w in state.items()] for state in weights[1:])
    assert all(same) and not any(other)


@pytest.mark.parametrize("shape", [(16, 144), (96, 32), (64, 128)])
def test_orthogonal_keeps_directions_and_levels_strengths(shape: tuple[int, int]) -> None:
    """Against LAPACK's singular value decomposition."""
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(3))
    result = muon.orthogonal(matrix[None])[0]
    strength = torch.linalg.svdvals(result)
    assert strength.min() > 0.5 and strength.max() < 1.35
    u, _, v = torch.linalg.svd(matrix, full_matrices=False)
    nearest = u @ v
    assert float((result * nearest).sum() / nearest.norm() ** 2) > 0.8


def test_every_weight_is_in_one_optimizer() -> None:
    network = main_network.MainNetwork(TINY)
    optimizers = loop.make_optimizers(network, 1e-3)
    held = [w for o in optimizers for g in o.param_groups for w in g["params"]]
    assert sorted(map(id, held)) == sorted(map(id, network.parameters()))
    name = {id(w): name for name, w in network.named_parameters()}
    hidden = {name[id(w)] for w in optimizers[0].param_groups[0]["params"]}
    assert {"down.0.weight", "profiles.read.0.weight", "geometry.skip.0.weight"} <= hidden
    assert not hidden & {"stem.weight", "recolor.knots", "gloss.out.weight", "gloss.raw.weight", "stem.bias"}
