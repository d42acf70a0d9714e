"""In: the path of an ONNX model. Out: a `Network`, ready to run on the provider that was asked for.

A model says in its metadata what it eats and under which terms it may be used:

    channels       names of its input channels, in order, separated by commas
    encoding       version of the channels' formulas: `ENCODING`, or of `stages/mask/mask_channels.py`
    native_size    longer side at which inference shows it a picture, px
    size_multiple  height and width must be multiples of this
    licence        SPDX name of the weights' licence

A file that does not say so is refused. The only module that imports onnxruntime.
"""

from hashlib import blake2b
from pathlib import Path
from typing import Any, Literal

import numpy as np

from polcap.errors import ModelError
from polcap.images import Floats, Network

ENCODING = "1"
NUMBERS = ("native_size", "size_multiple")
REQUIRED = ("channels", "encoding", *NUMBERS, "licence")
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_REMOTE = "AzureExecutionProvider"  # calls a service; computes nothing here
Device = Literal["cpu", "cuda", "auto"]


def load(path: str | Path, device: Device = "cpu", threads: int = 0, encoding: str = ENCODING) -> Network:
    """Open a model; `threads` 0 leaves their number to the runtime, `encoding` is that of the channels it must eat.

    `cuda` fails where the provider is missing or does not start; `auto` takes it where it starts.

    Raises
    ------
    ModelError
        No such file, not a model this runtime can run, metadata missing or of another encoding,
        or the device is not there.
    """
    import onnxruntime

    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror or error}; name a model file with --model") from error
    if device == "cuda" and CUDA not in onnxruntime.get_available_providers():
        raise ModelError("--device cuda: this onnxruntime has no CUDA; install onnxruntime-gpu, or use --device cpu")
    wanted = [CPU] if device == "cpu" or CUDA not in onnxruntime.get_available_providers() else [CUDA, CPU]
    session = _open(path, data, wanted, threads)
    provider = session.get_providers()[0]
    if device == "cuda" and provider != CUDA:
        raise ModelError("--device cuda: CUDA does not start; make driver, CUDA and cuDNN fit, or use --device cpu")
    metadata = {str(k): str(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}
    channels = _check(path, session, metadata, encoding)
    return Network(
        run=lambda inputs: _run(path, session, inputs),
        digest=blake2b(data, digest_size=16).hexdigest(),
        channels=channels,
        metadata=metadata,
        provider=provider,
    )


def providers(path: Path) -> dict[str, str]:
    """Every provider this onnxruntime has for this machine, and why it does not run the model; "" where it does."""
    import onnxruntime

    found = {}
    for name in onnxruntime.get_available_providers():
        if name == _REMOTE:
            continue
        try:
            session = _open(path, path.read_bytes(), [name], 0)
            shape = session.get_inputs()[0].shape
            sides = [side if isinstance(side, int) else 64 for side in shape[2:]]
            _run(path, session, np.zeros((1, shape[1], *sides), np.float32))
            found[name] = "" if session.get_providers()[0] == name else "does not start"
        except ModelError as error:
            found[name] = str(error)
    return found


def _open(path: Path, data: bytes, providers: list[str], threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # its failures are raised, and told once
    options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(data, options, providers=providers)
    except _failures() as error:
        raise ModelError(
            f"{path} is not a model that onnxruntime {onnxruntime.__version__} can run: {_line(error)}; "
            "take an ONNX file of opset ≤ 18 that is whole"
        ) from error


def _check(path: Path, session: Any, metadata: dict[str, str], encoding: str) -> tuple[str, ...]:
    missing = [name for name in REQUIRED if not metadata.get(name)]
    if missing:
        raise ModelError(f"{path}: its metadata does not state {', '.join(missing)}; export it with polcap")
    if metadata["encoding"] != encoding:
        raise ModelError(
            f"{path}: input encoding {metadata['encoding']}, this polcap makes {encoding}; "
            "take a model of the same release"
        )
    for name in NUMBERS:
        if not metadata[name].isdigit() or int(metadata[name]) < 1:
            raise ModelError(f"{path}: {name} = {metadata[name]!r} in its metadata is not a whole number ≥ 1")
    channels = tuple(name.strip() for name in metadata["channels"].split(","))
    entry = session.get_inputs()
    shape = entry[0].shape if entry else []
    if len(entry) != 1 or len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != len(channels)):
        takes = [one.shape for one in entry]
        raise ModelError(f"{path}: takes {takes}, its metadata names {len(channels)} channels of one input")
    return channels


def _run(path: Path, session: Any, inputs: Floats) -> dict[str, Floats]:
    entry = session.get_inputs()[0]
    dtype = np.float16 if entry.type == "tensor(float16)" else np.float32
    names = [output.name for output in session.get_outputs()]
    try:
        results = session.run(names, {entry.name: np.ascontiguousarray(inputs, dtype=dtype)})
    except _failures() as error:
        raise ModelError(f"{path} failed on an input of shape {inputs.shape}: {_line(error)}") from error
    return {name: np.asarray(result, dtype=np.float32) for name, result in zip(names, results, strict=True)}


def _failures() -> tuple[type[Exception], ...]:
    """onnxruntime's exceptions have no common base of their own."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    own = [kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, ValueError, RuntimeError)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
