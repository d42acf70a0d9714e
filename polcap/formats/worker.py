"""A function and a path in, its arrays out: untrusted files are decoded in a child process.

C libraries crash, hang and eat memory on damaged files. Here they may: the child is a
fresh interpreter (never a fork, so that no OpenMP state is copied), kept for the next
file, limited in time and memory. Its death is one `DecodeError` that names the file.
Arrays come back as raw bytes over the pipe, read straight into their final memory.
"""

import atexit
import contextlib
import importlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from polcap import errors

TIMEOUT_S = 180.0  # a 150 MP compressed frame takes about 6 s
MEMORY_GIB = 8.0  # address space of the child

Arrays = dict[str, NDArray[Any]]
Answer = tuple[dict[str, Any], Arrays]
_LENGTH = struct.Struct("<Q")
_START = "import sys; sys.path[:] = sys.argv[2:]; from polcap.formats import worker; worker.serve(float(sys.argv[1]))"


class Worker:
    """A child process that runs one function on one file at a time; restarts when it dies."""

    def __init__(self, timeout_s: float = TIMEOUT_S, memory_gib: float = MEMORY_GIB) -> None:
        self.timeout_s = timeout_s
        self.memory_gib = memory_gib
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None

    def call(self, function: str, path: str | os.PathLike[str], **options: Any) -> Answer:
        """Run `module:function(path, **options)` in the child; options are plain JSON values.

        Raises
        ------
        DecodeError
            The function refused the file, crashed, ran past `timeout_s` or out of memory.
        """
        request = json.dumps({"function": function, "path": os.fspath(path), "options": options}).encode()
        with self._lock:
            child = self._child if self._child and self._child.poll() is None else self._spawn()
            overdue = threading.Event()
            timer = threading.Timer(self.timeout_s, _kill, (child, overdue))
            timer.daemon = True
            timer.start()
            try:
                _send(cast(IO[bytes], child.stdin), request)
                head = json.loads(_receive(cast(IO[bytes], child.stdout)))
                arrays = {
                    name: _receive_array(cast(IO[bytes], child.stdout), dtype, shape)
                    for name, dtype, shape in head.get("arrays", [])
                }
            except (EOFError, OSError):
                code = child.wait()
                raise errors.DecodeError(self._obituary(path, code, overdue.is_set())) from None
            except BaseException:  # Ctrl-C amid an answer: the pipe is no longer in step
                self._stop()
                raise
            finally:
                timer.cancel()
        if "error" in head:
            raise getattr(errors, head["kind"])(head["error"])
        return head["meta"], arrays

    def close(self) -> None:
        with self._lock:
            self._stop()

    def _spawn(self) -> subprocess.Popen[bytes]:
        self._stop()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 — read at the child's death, closed in _stop
        self._child = subprocess.Popen(
            [sys.executable, "-c", _START, str(self.memory_gib), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,  # Ctrl-C is the parent's to handle
        )
        return self._child

    def _stop(self) -> None:
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

    def _obituary(self, path: str | os.PathLike[str], code: int, overdue: bool) -> str:
        name = os.fspath(path)
        if overdue:
            return f"{name}: not decoded within {self.timeout_s:g} s; the file is damaged or far too large"
        log = cast(IO[bytes], self._log)
        log.seek(0)
        last = log.read().decode(errors="replace").strip().rsplit("\n", 1)[-1].strip()
        memory = "MemoryError" in last or "bad_alloc" in last or code == -9
        cause = f"ran out of memory ({self.memory_gib:g} GiB)" if memory else f"crashed (exit {code}) {last}"
        return f"{name}: the decoder {cause.strip()}; the file is damaged, copy it from the card again"


def _kill(child: subprocess.Popen[bytes], overdue: threading.Event) -> None:
    overdue.set()
    child.kill()


_idle: list[Worker] = []
_owner = 0
_hold = threading.Lock()


def call(function: str, path: str | os.PathLike[str], **options: Any) -> Answer:
    """`Worker.call` on a child that is idle, or on a new one: as many as threads call at a time."""
    global _owner
    with _hold:
        if _owner != os.getpid():  # a fork must not share the pipes
            _idle.clear()
            _owner = os.getpid()
            atexit.register(_close)
        worker = _idle.pop() if _idle else Worker()
    try:
        return worker.call(function, path, **options)
    finally:
        with _hold:
            _idle.append(worker)


def _close() -> None:
    for worker in _idle:
        worker.close()


def serve(memory_gib: float) -> None:
    """Answer requests on stdin until it closes. Runs in the child only."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not fall into the answers
    _limit(memory_gib)
    while True:
        try:
            request = json.loads(_receive(requests))
        except EOFError:
            return
        arrays: Arrays = {}
        try:
            meta, arrays = _function(request["function"])(request["path"], **request["options"])
            head: dict[str, Any] = {
                "meta": meta,
                "arrays": [(name, array.dtype.str, array.shape) for name, array in arrays.items()],
            }
        except errors.InputError as error:
            head = {"error": str(error), "kind": type(error).__name__}
        except MemoryError:
            head = {
                "error": f"{request['path']}: decoding needs more than {memory_gib:g} GiB of memory; "
                "the file is damaged or far too large",
                "kind": "DecodeError",
            }
        _send(answers, json.dumps(head).encode())
        for array in arrays.values():
            answers.write(np.ascontiguousarray(array).data)
        answers.flush()


def _limit(memory_gib: float) -> None:
    if sys.platform == "win32":  # no such limits there; the time limit still holds
        return
    import resource

    size = int(memory_gib * 2**30)
    with contextlib.suppress(ValueError, OSError):  # macOS refuses RLIMIT_AS; a tighter limit may already stand
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _function(name: str) -> Callable[..., Answer]:
    module, _, attribute = name.partition(":")
    return cast(Callable[..., Answer], getattr(importlib.import_module(module), attribute))


def _send(pipe: IO[bytes], message: bytes) -> None:
    pipe.write(_LENGTH.pack(len(message)) + message)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> bytes:
    (length,) = _LENGTH.unpack(_exactly(pipe, _LENGTH.size))
    return _exactly(pipe, length)


def _exactly(pipe: IO[bytes], length: int) -> bytes:
    data = pipe.read(length)
    if len(data) < length:
        raise EOFError
    return data


def _receive_array(pipe: IO[bytes], dtype: str, shape: list[int]) -> NDArray[Any]:
    array = np.empty(shape, dtype)
    view = memoryview(cast(Any, array.reshape(-1).view(np.uint8)))
    while view:
        count = cast(Any, pipe).readinto(view)
        if not count:
            raise EOFError
        view = view[count:]
    return array
