"""In: the path of an ONNX model. Out: a `Network`, ready to run on the provider that was asked for.

A model says in its metadata what it eats and under which terms it may be used:

    channels       names of its input channels, in order, separated by commas
    encoding       version of the channels' formulas: `ENCODING`, or of `stages/mask/mask_channels.py`
    native_size    longer side at which inference shows it a picture, px
    size_multiple  height and width must be multiples of this
    licence        SPDX name of the weights' licence

A file that does not say so is refused. A model that polcap does not ship is first loaded and run on a small picture
in the limited child: what crashes, loops or eats memory there never reaches this process. Here each run has a time
limit. The only module that imports onnxruntime: in `_onnxruntime`, which turns its telemetry off.
"""

import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, Literal

import numpy as np

from polcap import parallel
from polcap.errors import DecodeError, ModelError
from polcap.formats import shipped_data, text_file
from polcap.formats.raw import worker
from polcap.images import Floats, Network

ENCODING = "1"
NUMBERS = ("native_size", "size_multiple")
REQUIRED = ("channels", "encoding", *NUMBERS, "licence")
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_REMOTE = "AzureExecutionProvider"  # calls a service; computes nothing here
Device = Literal["cpu", "cuda", "auto"]
_MOST_BYTES = 1 << 30  # of a model; the one that is shipped has 15 MB
_TRIAL_S, _TRIAL_GIB, _TRIAL_PX = 60.0, 4.0, 64
_RUN_S = 300.0  # the shipped model takes 2 s for a picture on one core
_AT_ONCE = 4  # runs side by side, at most: positions that a network looks from
_MOST_NUMBER = 1 << 16  # px; of what the metadata state


def load(path: str | Path, device: Device = "cpu", threads: int = 0, encoding: str = ENCODING) -> Network:
    """Open a model, after a trial in a child where it is none that polcap ships.

    Parameters
    ----------
    path
        The file.
    device
        `cuda` fails where the provider is missing or does not start; `auto` takes it where it starts.
    threads
        0 is as many as may run.
    encoding
        Of the channels that the model must eat.

    Raises
    ------
    ModelError
        No such file, not a model this runtime can run, metadata missing or of another encoding,
        or the device is not there.
    """
    path = Path(path)
    data = _bytes(path)
    mark = digest(data)
    onnxruntime = _onnxruntime()
    if path not in _shipped_files() and mark not in _shipped():
        _try(path, mark, encoding)
    if device == "cuda" and CUDA not in onnxruntime.get_available_providers():
        raise ModelError("--device cuda: this onnxruntime has no CUDA; install onnxruntime-gpu, or use --device cpu")
    wanted = [CPU] if device == "cpu" or CUDA not in onnxruntime.get_available_providers() else [CUDA, CPU]
    session = _open(path, data, wanted, threads)
    provider = session.get_providers()[0]
    if device == "cuda" and provider != CUDA:
        raise ModelError("--device cuda: CUDA does not start; make driver, CUDA and cuDNN fit, or use --device cpu")
    metadata = _metadata(path, session)
    channels = _check(path, session, metadata, encoding)
    model = Model(path, session)
    return Network(model, mark, channels, metadata, provider, at_once=_at_once(provider, threads))


def digest(data: bytes) -> str:
    """What the bytes of a model put into the key of all that is made with it."""
    return blake2b(data, digest_size=16).hexdigest()


@dataclass(frozen=True)
class Model:
    """An open model: channels (1, N, H, W) in, maps by name (1, n, H, W) out."""

    path: Path
    session: Any
    limit_s: float = _RUN_S

    def __call__(self, inputs: Floats) -> dict[str, Floats]:
        """Run it.

        Raises
        ------
        ModelError
            It fails on such an input, does not end, or answers with something that is no map of it.
        """
        session = self.session
        entry = session.get_inputs()[0]
        dtype = np.float16 if entry.type == "tensor(float16)" else np.float32
        names = [output.name for output in session.get_outputs()]
        options = _onnxruntime().RunOptions()
        overdue = threading.Timer(self.limit_s, setattr, (options, "terminate", True))
        overdue.daemon = True
        overdue.start()
        try:
            results = session.run(names, {entry.name: np.ascontiguousarray(inputs, dtype=dtype)}, options)
        except _failures() as error:
            if options.terminate:
                raise ModelError(f"{self.path} did not end within {self.limit_s:g} s; take another model") from error
            raise ModelError(f"{self.path} failed on an input of shape {inputs.shape}: {_line(error)}") from error
        finally:
            overdue.cancel()
        return {name: self._map(name, value, inputs) for name, value in zip(names, results, strict=True)}

    def _map(self, name: str, value: Any, inputs: Floats) -> Floats:
        if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
            raise ModelError(f"{self.path}: its output {name} holds no floating-point numbers; take another model")
        if value.ndim != 4 or value.shape[0] != 1 or value.shape[2:] != inputs.shape[2:]:
            raise ModelError(f"{self.path}: its output {name} is {value.shape} for an input of {inputs.shape}")
        if not np.isfinite(value).all():
            raise ModelError(f"{self.path}: its output {name} holds NaN or infinity; take another model")
        return np.asarray(value, dtype=np.float32)


def trial(path: str, expected: str, encoding: str) -> worker.Answer:
    """Load a model and run it on a small picture of noise. In the worker.

    Raises
    ------
    ModelError
        What is wrong with it, as `load` says it.
    """
    file = Path(path)
    data = _bytes(file)
    if digest(data) != expected:
        raise ModelError(f"{path}: has changed while it was read; run again")
    session = _open(file, data, [CPU], 1)
    metadata = _metadata(file, session)
    channels = _check(file, session, metadata, encoding)
    side = max(_TRIAL_PX, int(metadata["size_multiple"]))
    noise = np.random.default_rng(1).normal(size=(1, len(channels), side, side))
    Model(file, session)(noise.astype(np.float32))
    return {}, {}


def _at_once(provider: str, threads: int) -> int:
    """Runs that may go side by side: two of a thread each end sooner than one after another on two threads."""
    return min(threads or parallel.threads(), _AT_ONCE) if provider == CPU else 1


def _try(path: Path, expected: str, encoding: str) -> None:
    try:
        worker.call(trial, path, limit_s=_TRIAL_S, limit_gib=_TRIAL_GIB, expected=expected, encoding=encoding)
    except DecodeError as error:
        raise ModelError(f"a trial run of the model failed: {error}") from error


@cache
def _shipped_files() -> frozenset[Path]:
    """The models that come with polcap."""
    return frozenset(shipped_data.data_path("colorchecker").parent.glob("models/*.onnx"))


@cache
def _shipped() -> frozenset[str]:
    """Their digests."""
    return frozenset(digest(file.read_bytes()) for file in _shipped_files())


def _bytes(path: Path) -> bytes:
    try:
        return text_file.read_bytes(path, _MOST_BYTES)
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror or error}; name a model file with --model") from error


def _metadata(path: Path, session: Any) -> Mapping[str, str]:
    try:
        return {str(k): str(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}
    except UnicodeError as error:
        raise ModelError(f"{path}: its metadata are no text ({error}); export it with polcap") from error


def providers(path: Path) -> dict[str, str]:
    """Every provider this onnxruntime has for this machine, and why it does not run the model; "" where it does."""
    found = {}
    for name in _onnxruntime().get_available_providers():
        if name == _REMOTE:
            continue
        try:
            session = _open(path, _bytes(path), [name], 0)
            shape = session.get_inputs()[0].shape
            sides = [side if isinstance(side, int) else _TRIAL_PX for side in shape[2:]]
            Model(path, session)(np.zeros((1, shape[1], *sides), np.float32))
            found[name] = "" if session.get_providers()[0] == name else "does not start"
        except ModelError as error:
            found[name] = str(error)
    return found


def _open(path: Path, data: bytes, providers: list[str], threads: int) -> Any:
    onnxruntime = _onnxruntime()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # its failures are raised, and told once
    options.intra_op_num_threads = max(1, (threads or parallel.threads()) - _AT_ONCE + 1)
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads sleep
    try:
        return onnxruntime.InferenceSession(data, options, providers=providers)
    except _failures() as error:
        raise ModelError(
            f"{path} is not a model that onnxruntime {onnxruntime.__version__} can run: {_line(error)}; "
            "take an ONNX file of opset ≤ 18 that is whole"
        ) from error


def _check(path: Path, session: Any, metadata: Mapping[str, str], encoding: str) -> tuple[str, ...]:
    """Names of the channels, which are those that the model takes."""
    channels = _stated(path, metadata, encoding)
    entry = session.get_inputs()
    shape = entry[0].shape if entry else []
    if len(entry) != 1 or len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != len(channels)):
        takes = [one.shape for one in entry]
        raise ModelError(f"{path}: takes {takes}, its metadata names {len(channels)} channels of one input")
    return channels


def _stated(path: Path, metadata: Mapping[str, str], encoding: str) -> tuple[str, ...]:
    """Names of the channels, by the metadata alone."""
    missing = [name for name in REQUIRED if not metadata.get(name)]
    if missing:
        raise ModelError(f"{path}: its metadata does not state {', '.join(missing)}; export it with polcap")
    if metadata["encoding"] != encoding:
        raise ModelError(
            f"{path}: input encoding {metadata['encoding']}, this polcap makes {encoding}; "
            "take a model of the same release"
        )
    for name in NUMBERS:
        if not _usable(metadata[name]):
            value = metadata[name][:20]
            raise ModelError(f"{path}: {name} = {value!r} in its metadata is not a whole number of 1 to {_MOST_NUMBER}")
    return tuple(name.strip() for name in metadata["channels"].split(","))


def _usable(number: str) -> bool:
    return len(number) < 9 and number.isascii() and number.isdecimal() and 1 <= int(number) <= _MOST_NUMBER


def _onnxruntime() -> Any:
    """The library, imported without its telemetry: a device id below the home folder, and events sent to its maker.

    It reads the variable once, when it is first imported. Child processes inherit it.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    return onnxruntime


def _failures() -> tuple[type[Exception], ...]:
    """onnxruntime's exceptions have no common base of their own."""
    state = vars(_onnxruntime().capi.onnxruntime_pybind11_state)
    own = [kind for kind in state.values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, ValueError, RuntimeError)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
