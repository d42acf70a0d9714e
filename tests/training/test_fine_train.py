"""Training of the refinement network: tiles rotate with their vectors, the loss falls, the model is exported."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from polcap.formats import onnx
from polcap.stages.infer import fine
from polcap.training import fine_train

COUNT = len(fine.CHANNELS)


@pytest.fixture
def picture() -> NDArray[np.float16]:
    """A picture file with waves in the channel `smooth_x` and in the true normals, but not in the first normals."""
    rng = np.random.default_rng(2)
    out = np.zeros((COUNT + 4, 160, 200), np.float32)
    wave = 0.3 * np.sin(np.arange(200) * 2 * np.pi / 8 + rng.uniform(0, 6, (160, 1)))
    out[fine.CHANNELS.index("smooth_x")] = wave
    for first in (fine.CHANNELS.index("normal_x"), COUNT):
        out[first + 2] = 1
    out[COUNT] = wave / np.sqrt(1 + wave**2)
    out[COUNT + 2] = 1 / np.sqrt(1 + wave**2)
    out[COUNT - 1], out[-1] = np.log(2.0), 1
    return out.astype(np.float16)


def test_four_quarter_turns_change_nothing(picture: NDArray[np.float16]) -> None:
    rng = np.random.default_rng(3)
    shown = rng.normal(size=(COUNT + 4, 16, 16)).astype(np.float32)
    twice = fine_train.rotate(fine_train.rotate(shown, 1, False), 3, False)
    assert np.allclose(twice, shown)
    assert np.allclose(fine_train.rotate(fine_train.rotate(shown, 0, True), 0, True), shown)
    right = np.zeros_like(shown)
    right[COUNT] = 1  # relief to the right: after a quarter turn counter-clockwise it points up
    assert np.allclose(fine_train.rotate(right, 1, False)[COUNT + 1], 1)


def test_the_network_learns_and_is_exported(tmp_path: Path, picture: NDArray[np.float16]) -> None:
    file = tmp_path / "00000.npy"
    np.save(file, picture)
    run = fine_train.FineTraining(3e-3, [file])
    losses = [run.advance([file], 0.0)["loss"] for _ in range(40)]
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    run.export(tmp_path / "fine.onnx", "MIT")
    network = onnx.load(tmp_path / "fine.onnx", threads=1, encoding=fine.ENCODING)
    assert network.channels == fine.CHANNELS
    shown = fine_train.load_example(file)[:COUNT].astype(np.float32)[None]
    with torch.no_grad():
        own = run.average(torch.from_numpy(shown)).numpy()
    assert np.abs(onnx.run(network, shown)["relief"] - own).max() < 2e-3  # weights in halves
