"""Opens and runs the networks of ONNX files, by onnxruntime on the CPU or on CUDA.

A model states in its metadata which input it takes, and its licence:

    channels       names of its input channels, in order, separated by commas
    encoding       version of the channels' formulas: `ENCODING`, or of `stages/mask/mask_channels.py`
    native_size    longer side of the pictures it was trained on, px
    size_multiple  height and width must be multiples of this
    licence        SPDX name of the weights' licence

A file without these is refused. A model that polcap does not ship is first run on a small picture in a child process
with limits, so that a crash, an endless loop or a lack of memory cannot end polcap. Every run has a time limit. No
other module imports onnxruntime; `_onnxruntime` turns its telemetry off.
"""

import os
import re
import threading
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from polcap import parallel
from polcap.errors import DecodeError, ModelError, one_line
from polcap.formats import sandbox, shipped_data, text_file
from polcap.image_values import Device, Floats
from polcap.stage_values import Network

ENCODING = "1"
NUMBERS = ("native_size", "size_multiple")
REQUIRED = ("channels", "encoding", *NUMBERS, "licence")
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_REMOTE = "AzureExecutionProvider"  # calls a service; computes nothing here
_MAX_BYTES = 1 << 30  # of a model; the shipped one has 15 MB
_TRIAL_S, _TRIAL_PX = 60.0, 64  # time limit of a trial run, and side of its picture
_RUN_S = 300.0  # the shipped model takes 2 s for a picture on one core
_AT_ONCE = 4  # runs in parallel, at most: views of one picture
_OPEN_SESSIONS = 8  # a run uses up to three networks
_MAX_NUMBER = 1 << 16  # px; of a size in the metadata


def load(path: str | Path, device: Device = "cpu", threads: int = 0, encoding: str = ENCODING) -> Network:
    """Open an ONNX network; a model that polcap does not ship is first tried in a child process.

    With `device` "cuda" it is an error if CUDA does not start; "auto" uses the CPU then. `threads` 0 means all that
    polcap may use. `encoding` is the version of the input channels that the model must expect.

    Raises ModelError: the file is missing or no model that this runtime can run, its metadata are missing or of another
    encoding, or there is no such device.
    """
    path = Path(path)
    file_digest = digest(_bytes(path))
    if file_digest not in {digest(file.read_bytes()) for file in shipped_data.model_files()}:
        try:
            sandbox.call(trial, path, limit_s=_TRIAL_S, expected=file_digest, encoding=encoding)
        except DecodeError as error:
            raise ModelError(f"a trial run of the model failed: {error}") from error
    session = _session(str(path), file_digest, device, threads)
    channels, metadata = _check(path, session, encoding)
    # two runs on one thread each end sooner than one after the other on two threads
    at_once = min(threads or parallel.threads(), _AT_ONCE) if session.get_providers()[0] == CPU else 1
    return Network(file_digest, channels, metadata, None, str(path), device, threads, at_once)


def digest(data: bytes) -> str:
    """BLAKE2b digest of 128 bits of a model file's bytes; enters the cache key of every stage that uses the model."""
    return blake2b(data, digest_size=16).hexdigest()


def run(network: Network, inputs: Floats) -> dict[str, Floats]:
    """Run a network on input channels (1, N, H, W); returns maps by name, (1, n, H, W) each. Raises ModelError."""
    session = _session(network.path, network.digest, network.device, network.threads)
    return run_session(session, Path(network.path), inputs)


def run_session(session: Any, path: Path, inputs: Floats, limit_s: float = _RUN_S) -> dict[str, Floats]:
    """Run an open onnxruntime session on channels (1, N, H, W); `path` is only for messages. Raises ModelError."""
    entry = session.get_inputs()[0]
    dtype = np.float16 if entry.type == "tensor(float16)" else np.float32
    names = [output.name for output in session.get_outputs()]
    options = _onnxruntime().RunOptions()
    overdue = threading.Timer(limit_s, setattr, (options, "terminate", True))
    overdue.daemon = True
    overdue.start()
    try:
        results = session.run(names, {entry.name: np.ascontiguousarray(inputs, dtype=dtype)}, options)
    except _failures() as error:
        if options.terminate:
            raise ModelError(f"{path} did not end within {limit_s:g} s; use another model") from error
        raise ModelError(
            f"{path} failed on an input of shape {inputs.shape}: {one_line(error)[:200]}; use another model"
        ) from error
    finally:
        overdue.cancel()
    for name, value in zip(names, results):
        if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
            raise ModelError(f"{path}: its output {name} is not an array of floating-point numbers; use another model")
        if value.ndim != 4 or value.shape[0] != 1 or value.shape[2:] != inputs.shape[2:]:
            raise ModelError(f"{path}: its output {name} is {value.shape} for an input of {inputs.shape}")
        if not np.isfinite(value).all():
            raise ModelError(f"{path}: its output {name} holds NaN or infinity; use another model")
    return {name: np.asarray(value, dtype=np.float32) for name, value in zip(names, results)}


@lru_cache(_OPEN_SESSIONS)
def _session(path: str, expected: str, device: Device, threads: int) -> Any:
    """Open an onnxruntime session for a model file. Raises ModelError: its digest is not `expected`, or as `load`."""
    data = _bytes(Path(path))
    if digest(data) != expected:
        raise ModelError(f"{path}: changed while polcap was using it; leave the file alone and run again")
    has_cuda = CUDA in _onnxruntime().get_available_providers()
    if device == "cuda" and not has_cuda:
        raise ModelError("--device cuda: this onnxruntime has no CUDA; install onnxruntime-gpu, or use --device cpu")
    session = _open(Path(path), data, [CUDA, CPU] if has_cuda and device != "cpu" else [CPU], threads)
    if device == "cuda" and session.get_providers()[0] != CUDA:
        raise ModelError("--device cuda: CUDA does not start; make driver, CUDA and cuDNN fit, or use --device cpu")
    return session


def trial(path: str, expected: str, encoding: str) -> sandbox.Answer:
    """Try in the child process whether a model runs on a small picture of noise; `expected` is its file's digest.

    Raises ModelError: as `load`.
    """
    session = _session(path, expected, "cpu", 1)
    channels, metadata = _check(Path(path), session, encoding)
    side = max(_TRIAL_PX, int(metadata["size_multiple"]))
    noise = np.random.default_rng(1).normal(size=(1, len(channels), side, side))
    run_session(session, Path(path), noise.astype(np.float32))
    return {}, {}  # nothing but the errors matters


def _bytes(path: Path) -> bytes:
    try:
        return text_file.read_bytes(path, _MAX_BYTES)
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror or error}; give the path of an ONNX model") from error


def providers(path: Path) -> dict[str, str]:
    """The execution providers of this onnxruntime (CPU, CUDA…), each with the reason why it fails on a model, or ""."""
    found = {}
    for name in _onnxruntime().get_available_providers():
        if name == _REMOTE:
            continue
        try:
            session = _open(path, _bytes(path), [name], 0)
            shape = session.get_inputs()[0].shape
            sides = [side if isinstance(side, int) else _TRIAL_PX for side in shape[2:]]
            run_session(session, path, np.zeros((1, shape[1], *sides), np.float32))
            found[name] = "" if session.get_providers()[0] == name else "does not start"
        except ModelError as error:
            found[name] = str(error)
    return found


def _open(path: Path, data: bytes, providers: list[str], threads: int) -> Any:
    """Open a session of onnxruntime. Raises ModelError: it cannot run this model."""
    onnxruntime = _onnxruntime()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # failures are raised instead
    # of these, onnxruntime starts all but one; each of up to `_AT_ONCE` parallel runs adds the thread that calls it
    options.intra_op_num_threads = max(1, (threads or parallel.threads()) - _AT_ONCE + 1)
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads sleep
    try:
        return onnxruntime.InferenceSession(data, options, providers=providers)
    except _failures() as error:
        raise ModelError(
            f"{path} is not a model that onnxruntime {onnxruntime.__version__} can run: {one_line(error)[:200]}; "
            "use a complete ONNX file of opset ≤ 18"
        ) from error


def _check(path: Path, session: Any, encoding: str) -> tuple[tuple[str, ...], dict[str, str]]:
    """Names of the model's input channels, and its metadata. Raises ModelError."""
    try:
        metadata = {str(k): str(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}
    except UnicodeError as error:
        raise ModelError(f"{path}: its metadata are not text ({error}); export it with polcap") from error
    missing = [name for name in REQUIRED if not metadata.get(name)]
    if missing:
        raise ModelError(
            f"{path}: its metadata does not state {', '.join(missing)}; add them as docs/explanations/network.md shows"
        )
    if metadata["encoding"] != encoding:
        raise ModelError(
            f"{path}: input encoding {metadata['encoding']}, this polcap makes {encoding}; "
            "take a model of the same release"
        )
    for name in NUMBERS:
        if not re.fullmatch("[0-9]{1,8}", metadata[name]) or not 1 <= int(metadata[name]) <= _MAX_NUMBER:
            value = metadata[name][:20]
            raise ModelError(f"{path}: {name} = {value!r} in its metadata is not a whole number of 1 to {_MAX_NUMBER}")
    channels = tuple(name.strip() for name in metadata["channels"].split(","))
    shapes = [one.shape for one in session.get_inputs()]
    if len(shapes) != 1 or len(shapes[0]) != 4 or (isinstance(shapes[0][1], int) and shapes[0][1] != len(channels)):
        raise ModelError(
            f"{path}: takes inputs {shapes}, but its metadata names {len(channels)} channels of one input; "
            "use another model"
        )
    return channels, metadata


def _onnxruntime() -> Any:
    """Import onnxruntime with its telemetry (a device id in the home folder, events sent to its maker) turned off.

    An environment variable turns it off; onnxruntime reads it at its first import, and child processes inherit it.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    return onnxruntime


def _failures() -> tuple[type[Exception], ...]:
    """The exception types that onnxruntime raises; they have no common base class."""
    state = vars(_onnxruntime().capi.onnxruntime_pybind11_state)
    raised = [kind for kind in state.values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*raised, ValueError, RuntimeError)
