"""In: which model to use, if any is named. Out: the networks of the path, by default those that are shipped."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from polcap.errors import ModelError, SettingError
from polcap.formats import calib, onnx
from polcap.images import Network
from polcap.stages.infer import fine
from polcap.stages.mask import mask_channels


def load_network(
    estimator: Literal["network", "analytic"] | None, model: Path | None, device: onnx.Device, threads: int,
    later: bool = False,
) -> Network | None:  # fmt: skip
    """The model to use: the one named, else the one shipped; None is the analytic estimator.

    Parameters
    ----------
    estimator, model
        As the user names them; the one that is shipped brings its fine pass.
    device, threads, later
        As in `onnx.load`.

    Raises
    ------
    ModelError
        The network was asked for and there is none, or it cannot be used.
    """
    if estimator == "analytic":
        if model is not None:
            raise SettingError("--model and --estimator analytic exclude each other; leave one out")
        return None
    if model is None:
        shipped = sorted(calib.data_path("colorchecker").parent.glob("models/polcap*.onnx"))
        if not shipped and (estimator == "network" or device == "cuda"):
            raise ModelError("this polcap ships no model; name one with --model, or use --estimator analytic")
        if not shipped:
            return None
        beside = _shipped("fine", device, threads, fine.ENCODING, later)
        return replace(onnx.load(shipped[-1], device, threads, later=later), fine=beside)
    return onnx.load(model, device, threads, later=later)


def load_mask_network(threads: int = 0, later: bool = False) -> Network | None:
    """The network that finds the object, as shipped; None where this polcap ships none."""
    return _shipped("mask", "cpu", threads, mask_channels.ENCODING, later)


def shipped() -> tuple[Network | None, Network | None]:
    """Estimator and mask network as shipped."""
    return load_network(None, None, "cpu", 0), load_mask_network()


def _shipped(name: str, device: onnx.Device, threads: int, encoding: str, later: bool) -> Network | None:
    """The newest model of a name that comes with polcap, if any does."""
    files = sorted(calib.data_path("colorchecker").parent.glob(f"models/{name}*.onnx"))
    return onnx.load(files[-1], device, threads, encoding, later) if files else None
