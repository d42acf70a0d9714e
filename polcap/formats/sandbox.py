"""Runs a function on an untrusted file in a child process with limits on time and memory.

On damaged files, C libraries crash, hang or use up the memory. Here this ends one child process and raises a
`DecodeError` that names the file. The child is a new interpreter, not a fork, because a fork would copy OpenMP's state.
It is used again for the next file. Its answer has a limited size and contains only JSON and numbers, so a malicious
file that controls the child cannot run code in the parent. Arrays come back as raw bytes over a pipe.
"""

import atexit
import contextlib
import faulthandler
import importlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from typing import IO, Annotated, Any, cast

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from polcap import errors

START_S = 300.0  # until a child is ready; takes about a second, longer on a busy machine
TIMEOUT_S = 180.0  # from then on; a compressed frame of 150 MP takes about 6 s
MEMORY_GIB = 8.0  # address space of the child
_HEAD_BYTES = 4 << 20  # limit of an answer without its arrays; the metadata of a photograph take a few kB
_LOG_BYTES = 1 << 16  # end of the child's output, read after it died
_GRACE_S = 5.0  # the child's own time limit, which ends it without its parent, is later by this

Arrays = dict[str, NDArray[Any]]
Answer = tuple[dict[str, Any], Arrays]
Function = Callable[..., Answer]
_LENGTH = struct.Struct("<Q")
_READY = b"ready"  # the child has imported the function's module: its time starts to count
_CHILD = "import sys; sys.path[:] = sys.argv[2:]; from polcap.formats import sandbox; sandbox.serve(float(sys.argv[1]))"
_Type = Annotated[str, Meta(pattern=r"^[<>|=]?[biuf]\d{1,2}$")]
_Side = Annotated[int, Meta(ge=0, lt=2**31)]


class _Head(msgspec.Struct):
    """The child's answer without the values of its arrays: a result, a refusal of the file, or a defect of polcap."""

    meta: dict[str, Any] | None = None
    arrays: list[tuple[str, _Type, tuple[_Side, ...]]] = []  # name, type, shape
    error: str | None = None
    kind: str = ""  # class of the error; "" for `DecodeError`
    bug: str | None = None
    traceback: str = ""


class ChildBug(RuntimeError):
    """Error for a defect in polcap's code that runs in the child process; its note is the child's traceback."""


class Sandbox:
    """A child process that runs one function on one file at a time; it is started again after it died."""

    def __init__(self, timeout_s: float = TIMEOUT_S, memory_gib: float = MEMORY_GIB) -> None:
        self.timeout_s = timeout_s
        self.memory_gib = memory_gib
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None  # the child's stderr

    def call(
        self, function: Function, path: str | os.PathLike[str], limit_s: float | None = None, **options: Any
    ) -> Answer:
        """Run `function(path, **options)` in the child process and return its answer.

        The function must be at the top level of a module, the options plain JSON values. `limit_s` is a time limit
        shorter than the sandbox's.

        Raises DecodeError: the function refused the file, crashed, or exceeded its time or memory.
        Raises ChildBug: the function has a defect.
        """
        name, limit = os.fspath(path), min(self.timeout_s, limit_s or self.timeout_s)
        request = [function.__module__, function.__qualname__, name, options, limit, _working_folder()]
        with self._lock:
            try:
                head, arrays = self._exchange(name, request, limit)
            except (ValueError, TypeError, RecursionError) as error:
                self.close()
                raise errors.DecodeError(f"{name}: the decoder's answer is damaged ({error})") from error
            except BaseException:  # Ctrl-C in the middle of an answer: the rest of it would be taken for the next one
                self.close()
                raise
        if head.bug is not None:
            bug = ChildBug(f"{name}: {head.bug}")
            bug.add_note(head.traceback)
            raise bug
        if head.error is not None:
            kind = getattr(errors, head.kind, None)
            if isinstance(kind, type) and issubclass(kind, errors.InputError):
                raise kind(head.error)
            raise errors.DecodeError(f"{name}: {head.error}")
        return cast(dict[str, Any], head.meta), arrays

    def _exchange(self, name: str, request: list[Any], limit_s: float) -> tuple[_Head, Arrays]:
        """Send a request to the child process, wait until it is ready, and return its answer."""
        child = self._child if self._child and self._child.poll() is None else self._spawn()
        pipe = cast(IO[bytes], child.stdout)
        overdue = started = False

        def kill() -> None:
            nonlocal overdue
            overdue = True
            child.kill()

        timer = threading.Timer(START_S, kill)
        try:
            timer.start()
            _send(cast(IO[bytes], child.stdin), json.dumps(request).encode())
            _receive(pipe, len(_READY))
            started = True
            timer.cancel()
            timer = threading.Timer(limit_s, kill)
            timer.start()
            return self._answer(pipe)
        except (EOFError, OSError):
            code = child.wait()
            if overdue and not started:
                raise errors.DecodeError(f"{name}: no decoder started within {START_S:g} s; run again") from None
            raise errors.DecodeError(f"{name}: {self._cause_of_death(code, limit_s, overdue)}") from None
        finally:
            timer.cancel()

    def _answer(self, pipe: IO[bytes]) -> tuple[_Head, Arrays]:
        """Read the child process's answer: JSON, then arrays. Raises ValueError, TypeError or RecursionError."""
        head = msgspec.convert(json.loads(_receive(pipe, _HEAD_BYTES)), _Head)
        if head.meta is None and head.error is None and head.bug is None:
            raise ValueError("it is empty")
        arrays: Arrays = {}
        allowed = int(self.memory_gib * 2**30)
        for name, dtype, shape in head.arrays:
            kind = np.dtype(dtype)
            size = kind.itemsize * int(np.prod(shape, dtype=object))
            if kind.kind not in "biuf" or size > allowed:
                raise ValueError(f"{name} is {dtype} of {shape}")
            allowed -= size
            arrays[name] = np.empty(shape, kind)
            content = arrays[name].reshape(-1).view(np.uint8)
            if cast(Any, pipe).readinto(content.data) < content.size:  # it fills the array, or the pipe is at its end
                raise EOFError
        return head, arrays

    def _spawn(self) -> subprocess.Popen[bytes]:
        """Start a new child process."""
        self.close()
        # OpenCV adds a folder of its package to `sys.path`; a child would import `typing` from there, not Python's.
        folders = [one for one in sys.path if not os.path.isfile(os.path.join(one, "__init__.py"))]
        with contextlib.suppress(OSError):  # no temporary files: a crash is reported without its last line
            self._log = tempfile.TemporaryFile()  # noqa: SIM115 — read at the child's death, closed in `close`
        self._child = subprocess.Popen(
            [sys.executable, "-c", _CHILD, str(self.memory_gib), *folders],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log or subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is the parent's to handle
        )
        return self._child

    def close(self) -> None:
        """End the child process; the next call starts another one."""
        if self._child:
            self._child.kill()
            self._child.wait()
            for pipe in (self._child.stdin, self._child.stdout):
                with contextlib.suppress(OSError):  # a broken pipe has unsent bytes
                    cast(IO[bytes], pipe).close()
            self._child = None
        if self._log:
            self._log.close()
            self._log = None

    def _cause_of_death(self, code: int, limit_s: float, overdue: bool) -> str:
        """Why the child died, with a remedy, from its exit code and its last line."""
        if overdue:
            return f"not decoded within {limit_s:g} s; the file is damaged or far too large"
        if code == -9:  # by the kernel or by a person
            return "the system ended the decoder, most often for lack of memory; close other programs and run again"
        last = ""
        if self._log:
            self._log.seek(max(0, self._log.seek(0, os.SEEK_END) - _LOG_BYTES))
            last = self._log.read().decode(errors="replace").strip().rsplit("\n", 1)[-1].strip()
        memory = "MemoryError" in last or "bad_alloc" in last
        cause = f"ran out of memory ({self.memory_gib:g} GiB)" if memory else f"crashed (exit {code}) {last}"
        return f"the decoder {cause.strip()}; the file is damaged, copy it from the card again"


_idle: list[Sandbox] = []
_idle_lock = threading.Lock()
if hasattr(os, "register_at_fork"):  # a fork must not share the pipes
    os.register_at_fork(after_in_child=_idle.clear)


def call(function: Function, path: str | os.PathLike[str], **options: Any) -> Answer:
    """Run a function on an untrusted file in an idle child process, or in a new one, as `Sandbox.call` does."""
    with _idle_lock:
        sandbox = _idle.pop() if _idle else Sandbox()
    try:
        return sandbox.call(function, path, **options)
    finally:
        with _idle_lock:
            _idle.append(sandbox)


@atexit.register
def end_idle() -> None:
    """End all idle child processes; the next call starts another one."""
    for sandbox in _idle:
        sandbox.close()


def _working_folder() -> str:
    """Path of this process's working folder; "" if somebody removed it."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def serve(memory_gib: float) -> None:
    """Main loop of the child process: answer requests from stdin until it is closed."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a library's output must not mix with the answers
    _limit_memory(memory_gib)
    while True:
        try:
            module, name, path, options, limit_s, folder = json.loads(_receive(requests, _HEAD_BYTES))
        except EOFError:
            return
        with contextlib.suppress(OSError):
            os.chdir(folder)  # the parent may have changed its own, from which relative paths count
        with contextlib.suppress(Exception):  # `_run` reports it
            importlib.import_module(module)
        _send(answers, _READY)
        # ends this process after its time if the parent, which should do so, was killed; this thread of faulthandler
        # works even while a C library holds the interpreter
        faulthandler.dump_traceback_later(limit_s + _GRACE_S, exit=True)
        head, arrays = _run(module, name, path, options, memory_gib)
        faulthandler.cancel_dump_traceback_later()
        _send(answers, json.dumps(head).encode())
        for array in arrays.values():
            answers.write(np.ascontiguousarray(array).data)
        answers.flush()
        head, arrays = {}, {}  # an idle child holds no picture


def _run(module: str, name: str, path: str, options: dict[str, Any], memory_gib: float) -> Answer:
    """In the child process: run one request; the answer is a result, an error or a bug report."""
    try:
        meta, arrays = getattr(importlib.import_module(module), name)(path, **options)
    except errors.InputError as error:
        return {"error": str(error), "kind": type(error).__name__}, {}
    except MemoryError:
        message = f"{path}: decoding needs more than {memory_gib:g} GiB of memory; the file is damaged or far too large"
        return {"error": message, "kind": "DecodeError"}, {}
    except Exception as error:
        return {"bug": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}, {}
    return {"meta": meta, "arrays": [(name, array.dtype.str, array.shape) for name, array in arrays.items()]}, arrays


def _limit_memory(memory_gib: float) -> None:
    """In the child: limit its memory, and write no core file."""
    if sys.platform == "win32":  # only the time limit holds there
        return
    import resource

    size = int(memory_gib * 2**30)
    with contextlib.suppress(ValueError, OSError):  # macOS refuses RLIMIT_AS; a tighter limit may be set already
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _send(pipe: IO[bytes], message: bytes) -> None:
    """Write a message: its length, then its bytes."""
    pipe.write(_LENGTH.pack(len(message)) + message)
    pipe.flush()


def _receive(pipe: IO[bytes], limit: int) -> bytes:
    """Read a message: its length, then its bytes. Raises EOFError, ValueError: it is longer than `limit`."""
    (length,) = _LENGTH.unpack(_exactly(pipe, _LENGTH.size))
    if length > limit:
        raise ValueError(f"{length} bytes where {limit} are allowed")
    return _exactly(pipe, length)


def _exactly(pipe: IO[bytes], length: int) -> bytes:
    data = pipe.read(length)
    if len(data) < length:
        raise EOFError
    return data
