"""In: which model to use, if any is named. Out: the networks of the path, by default those that are shipped."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from polcap.errors import ModelError, SettingError
from polcap.formats import onnx, shipped_data
from polcap.images import Network
from polcap.stages.infer import fine
from polcap.stages.mask import mask_channels


def load_network(
    estimator: Literal["network", "analytic"] | None, model: Path | None, device: onnx.Device = "cpu", threads: int = 0
) -> Network | None:
    """The model to use: the one named, else the one shipped; None is the analytic estimator.

    Parameters
    ----------
    estimator, model
        As the user names them.
    device, threads
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
    named = model or _newest("polcap")
    if named is None:
        if estimator == "network" or device == "cuda":
            raise ModelError("this polcap ships no model; name one with --model, or use --estimator analytic")
        return None
    return open_network(named, device, threads)


def open_network(path: Path, device: onnx.Device = "cpu", threads: int = 0) -> Network:
    """An estimator's model; the one that polcap ships brings its fine pass, which was trained with it alone."""
    network = onnx.load(path, device, threads)
    own, relief = _newest("polcap"), _newest("fine")
    if own is None or relief is None or (path != own and network.digest != onnx.digest(own.read_bytes())):
        return network
    return replace(network, fine=onnx.load(relief, device, threads, fine.ENCODING))


def load_mask_network(threads: int = 0) -> Network | None:
    """The network that finds the object, as shipped; None where this polcap ships none."""
    found = _newest("mask")
    return onnx.load(found, "cpu", threads, mask_channels.ENCODING) if found else None


def shipped() -> tuple[Network | None, Network | None]:
    """Estimator and mask network as shipped."""
    return load_network(None, None), load_mask_network()


def _newest(name: str) -> Path | None:
    """The last model of a name that comes with polcap."""
    files = shipped_data.model_files(name)
    return files[-1] if files else None
