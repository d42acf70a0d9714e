"""Opens the network files of the path: the model that the user names, else the shipped ones."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

from polcap.errors import ModelError, SettingError
from polcap.formats import onnx, shipped_data
from polcap.image_values import Device
from polcap.stage_values import Network
from polcap.stages.infer import fine
from polcap.stages.mask import mask_channels

Estimator = Literal["network", "analytic"]


@lru_cache(maxsize=1)
def load_networks(
    estimator: Estimator | None = None, model: Path | None = None, device: Device = "cpu", threads: int = 0
) -> tuple[Network | None, Network | None]:
    """Open the networks of the estimator and of the mask, once per process. Raises as `load_network`."""
    return load_network(estimator, model, device, threads), load_mask_network(threads)


def load_network(
    estimator: Estimator | None, model: Path | None, device: Device = "cpu", threads: int = 0
) -> Network | None:
    """Open the network of the normal estimator: the named model, else the shipped one; None: the analytic estimator.

    `device` and `threads` are those of `onnx.load`.

    Raises ModelError: a network is required and there is none, or it cannot be used. SettingError: a model was named
    for the analytic estimator.
    """
    for name, value, known in (
        ("estimator", estimator, (*get_args(Estimator), None)),
        ("device", device, get_args(Device)),
    ):
        if value not in known:  # from Python; the command line has checked it
            raise SettingError(f"{name} {value!r}: there is no such one; choose {' or '.join(map(repr, known))}")
    if estimator == "analytic":
        if model is not None:
            raise SettingError("--model and --estimator analytic exclude each other; leave one out")
        return None
    named = model or newest("polcap")
    if named is None:
        if estimator == "network" or device == "cuda":
            raise ModelError("this polcap ships no model; name one with --model, or use --estimator analytic")
        return None
    return open_network(named, device, threads)


def open_network(path: Path, device: Device = "cpu", threads: int = 0) -> Network:
    """Open an estimator's network. The shipped one comes with its refinement network, which was trained for it only."""
    network = onnx.load(path, device, threads)
    shipped, refiner = newest("polcap"), newest("fine")
    if shipped is None or refiner is None or (path != shipped and network.digest != onnx.digest(shipped.read_bytes())):
        return network
    return replace(network, fine=onnx.load(refiner, device, threads, fine.ENCODING))


def load_mask_network(threads: int = 0) -> Network | None:
    """Open the shipped network that segments the object; None if none is shipped."""
    found = newest("mask")
    return onnx.load(found, "cpu", threads, mask_channels.ENCODING) if found else None


def newest(name: str) -> Path | None:
    """Path of the newest shipped model with a file name that begins with `name`; None if none is shipped."""
    return max(shipped_data.model_files(name), default=None)
