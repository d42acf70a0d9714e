"""Runs a function on an untrusted file in a child process with limits on time and memory.

C libraries crash, hang and eat memory on damaged files; here that ends one child and raises one `DecodeError` that
names the file. The child is a fresh interpreter, never a fork (no OpenMP state is copied). It serves the next file
too, and it ends when its parent does, even inside a loop. Its answer is bounded and holds JSON and numbers only, so a
file that takes over the child gains nothing from the parent. Arrays come back as raw bytes over the pipe, read
straight into their final memory.
"""

import atexit
import contextlib
import faulthandler
import importlib
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from polcap import errors

START_S = 300.0  # until a child is ready; takes about a second, longer on a busy machine
TIMEOUT_S = 180.0  # from then on; a compressed frame of 150 MP takes about 6 s
MEMORY_GIB = 8.0  # address space of the child
_HEAD_BYTES = 4 << 20  # limit of an answer without its arrays; the metadata of a photograph take a few kB
_LOG_BYTES = 1 << 16  # end of the child's output, read after it died
_GRACE_S = 5.0  # the child's own time limit is later than its parent's by this

Arrays = dict[str, NDArray[Any]]
Answer = tuple[dict[str, Any], Arrays]
_LENGTH = struct.Struct("<Q")
_READY = b"ready"  # the child has imported what it needs: its time starts to count
_CHILD = (
    "import sys; sys.path[:] = sys.argv[3:]; from polcap.formats.raw import worker; "
    "worker.serve(float(sys.argv[1]), int(sys.argv[2]))"
)


class ChildBug(RuntimeError):
    """A defect of polcap's own code that runs in the child; exit code 1. Its note is the child's traceback."""


class Worker:
    """A child process that runs one function on one file at a time; it is started again after it died."""

    def __init__(self, timeout_s: float = TIMEOUT_S, memory_gib: float = MEMORY_GIB) -> None:
        self.timeout_s = timeout_s
        self.memory_gib = memory_gib
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._lifeline: int | None = None  # our end of a pipe that closes with this process

    def call(
        self,
        function: Callable[..., Answer],
        path: str | os.PathLike[str],
        *,
        limit_s: float | None = None,
        limit_gib: float | None = None,
        **options: Any,
    ) -> Answer:
        """Run `function(path, **options)` in the child; the function is a module's, the options plain JSON values.

        `limit_s` and `limit_gib` are tighter limits than the worker's; the second is memory on top of the idle child's.

        Raises
        ------
        DecodeError
            The function refused the file, crashed, or exceeded its time or memory.
        ChildBug
            The function failed in a way that no file may cause.
        """
        name, limit = os.fspath(path), min(self.timeout_s, limit_s or self.timeout_s)
        request = {
            "module": function.__module__,
            "name": function.__qualname__,
            "path": name,
            "options": options,
            "limit_s": limit,
            "limit_gib": limit_gib,
        }
        with self._lock:
            try:
                head, arrays = self._exchange(name, request)
            except (ValueError, TypeError, KeyError) as error:
                self._stop()
                raise errors.DecodeError(f"{name}: the decoder's answer is damaged ({error})") from error
            except BaseException:  # Ctrl-C in the middle of an answer: the rest of it would be taken for the next one
                self._stop()
                raise
        if "bug" in head:
            bug = ChildBug(f"{name}: {head['bug']}")
            bug.add_note(str(head["traceback"]))
            raise bug
        if "error" in head:
            kind = getattr(errors, str(head.get("kind")), None)
            if isinstance(kind, type) and issubclass(kind, errors.InputError):
                raise kind(head["error"])
            raise errors.DecodeError(f"{name}: {head['error']}")
        if "meta" not in head:
            raise errors.DecodeError(f"{name}: the decoder's answer is damaged (it is empty)")
        return head["meta"], arrays

    def _exchange(self, name: str, request: dict[str, Any]) -> tuple[dict[str, Any], Arrays]:
        """Send the request, wait until the child is ready, then for its answer."""
        child = self._child if self._child and self._child.poll() is None else self._spawn()
        limit = request["limit_s"]
        started, overdue = False, threading.Event()
        try:
            with _killed_after(START_S, child, overdue):
                _send(cast(IO[bytes], child.stdin), json.dumps(request).encode())
                _receive(cast(IO[bytes], child.stdout), len(_READY))
            started = True
            with _killed_after(limit, child, overdue):
                return self._answer(cast(IO[bytes], child.stdout))
        except (EOFError, OSError):
            code = child.wait()
            if overdue.is_set() and not started:
                raise errors.DecodeError(f"{name}: no decoder started within {START_S:g} s; run again") from None
            gib = request["limit_gib"] or self.memory_gib
            raise errors.DecodeError(self._cause_of_death(name, code, limit, gib, overdue.is_set())) from None

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._stop()

    def _answer(self, pipe: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
        """Read the child's answer; ValueError where it is larger than allowed or holds no numbers."""
        head = json.loads(_receive(pipe, _HEAD_BYTES))
        arrays: Arrays = {}
        left = int(self.memory_gib * 2**30)
        for name, dtype, shape in head.get("arrays", ()):
            kind = np.dtype(dtype)
            size = kind.itemsize * int(np.prod(shape, dtype=object))
            if kind.kind not in "biuf" or not 0 <= size <= left:
                raise ValueError(f"{name} is {dtype} of {shape}")
            left -= size
            arrays[name] = _receive_array(pipe, kind, shape)
        return head, arrays

    def _spawn(self) -> subprocess.Popen[bytes]:
        self._stop()
        with contextlib.suppress(OSError):  # no temporary files: a crash is reported without its last line
            self._log = tempfile.TemporaryFile()  # noqa: SIM115 — read at the child's death, closed in _stop
        ours, theirs = _lifeline()
        try:
            self._child = subprocess.Popen(
                [sys.executable, "-c", _CHILD, str(self.memory_gib), str(theirs), *_module_folders()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log or subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is the parent's to handle
                pass_fds=() if theirs < 0 else (theirs,),
            )
        finally:
            self._lifeline = ours
            if theirs >= 0:
                os.close(theirs)
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
        if self._lifeline is not None:
            os.close(self._lifeline)
            self._lifeline = None

    def _cause_of_death(self, name: str, code: int, limit_s: float, gib: float, overdue: bool) -> str:
        if overdue or code == -getattr(signal, "SIGXCPU", 0):
            return f"{name}: not decoded within {limit_s:g} s; the file is damaged or far too large"
        last = self._last_line()
        memory = "MemoryError" in last or "bad_alloc" in last or code == -9
        cause = f"ran out of memory ({gib:g} GiB)" if memory else f"crashed (exit {code}) {last}"
        return f"{name}: the decoder {cause.strip()}; the file is damaged, copy it from the card again"

    def _last_line(self) -> str:
        if not self._log:
            return ""
        self._log.seek(max(0, self._log.seek(0, os.SEEK_END) - _LOG_BYTES))
        return self._log.read().decode(errors="replace").strip().rsplit("\n", 1)[-1].strip()


@contextlib.contextmanager
def _killed_after(limit_s: float, child: subprocess.Popen[bytes], overdue: threading.Event) -> Iterator[None]:
    """Kill the child and set `overdue` when the block takes too long."""

    def kill() -> None:
        overdue.set()
        child.kill()

    timer = threading.Timer(limit_s, kill)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _module_folders() -> list[str]:
    """`sys.path` without folders inside packages: OpenCV adds its own while it is imported.

    A child would import OpenCV's `typing` from there instead of Python's.
    """
    return [folder for folder in sys.path if not os.path.isfile(os.path.join(folder, "__init__.py"))]


def _lifeline() -> tuple[int | None, int]:
    """A pipe that nobody writes to: our end and the child's; -1 where a child cannot inherit one."""
    if os.name != "posix":
        return None, -1
    theirs, ours = os.pipe()
    return ours, theirs


_idle: list[Worker] = []
_owner = 0
_hold = threading.Lock()


def call(
    function: Callable[..., Answer],
    path: str | os.PathLike[str],
    *,
    limit_s: float | None = None,
    limit_gib: float | None = None,
    **options: Any,
) -> Answer:
    """`Worker.call` on an idle child, or on a new one: there are as many as threads call at a time."""
    global _owner
    with _hold:
        if _owner != os.getpid():  # a fork must not share the pipes
            _idle.clear()
            _owner = os.getpid()
            atexit.register(end_idle)
        worker = _idle.pop() if _idle else Worker()
    try:
        return worker.call(function, path, limit_s=limit_s, limit_gib=limit_gib, **options)
    finally:
        with _hold:
            _idle.append(worker)


def end_idle() -> None:
    """End the idle children; the next call starts one."""
    for worker in _idle:
        worker.close()


def serve(memory_gib: float, lifeline: int) -> None:
    """Answer requests on stdin until it closes. Runs in the child only."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a library's output must not mix with the answers
    _die_with_parent(lifeline)
    _limit(memory_gib)
    while True:
        try:
            request = json.loads(_receive(requests, _HEAD_BYTES))
        except EOFError:
            return
        with contextlib.suppress(Exception):  # `_run` reports it
            importlib.import_module(request["module"])
        _send(answers, _READY)
        with _time_limit(request["limit_s"]), _memory_limit(request["limit_gib"]):
            head, arrays = _run(request, request["limit_gib"] or memory_gib)
        _send(answers, json.dumps(head).encode())
        for array in arrays.values():
            answers.write(np.ascontiguousarray(array).data)
        answers.flush()
        head, arrays = {}, {}  # an idle child holds no picture


def _run(request: dict[str, Any], memory_gib: float) -> tuple[dict[str, Any], Arrays]:
    """The answer to one request: a result, an error or a bug."""
    path = request["path"]
    try:
        function = getattr(importlib.import_module(request["module"]), request["name"])
        meta, arrays = function(path, **request["options"])
    except errors.InputError as error:
        return {"error": str(error), "kind": type(error).__name__}, {}
    except MemoryError:
        much = f"{path}: decoding needs more than {memory_gib:g} GiB of memory; the file is damaged or far too large"
        return {"error": much, "kind": "DecodeError"}, {}
    except Exception as error:
        return {"bug": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}, {}
    return {"meta": meta, "arrays": [(name, array.dtype.str, array.shape) for name, array in arrays.items()]}, arrays


def _die_with_parent(lifeline: int) -> None:
    """Let the kernel end this process when the other end of the pipe closes, even inside a C function."""
    if sys.platform == "win32" or lifeline < 0:
        return
    import fcntl

    with contextlib.suppress(OSError):  # a system without this signal: the time limit ends a loop
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)


def _limit(memory_gib: float) -> None:
    if sys.platform == "win32":  # only the time limit holds there
        return
    import resource

    size = int(memory_gib * 2**30)
    with contextlib.suppress(ValueError, OSError):  # macOS refuses RLIMIT_AS; a tighter limit may be set already
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


@contextlib.contextmanager
def _memory_limit(more_gib: float | None) -> Iterator[None]:
    """Limit the memory of one request, on top of what the process uses now (Linux only)."""
    if more_gib is None or not sys.platform.startswith("linux"):
        yield
        return
    import resource

    with open("/proc/self/statm", encoding="ascii") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    usual = resource.getrlimit(resource.RLIMIT_AS)
    size = used + int(more_gib * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (size if usual[0] < 0 else min(size, usual[0]), usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, usual)


@contextlib.contextmanager
def _time_limit(limit_s: float) -> Iterator[None]:
    """End this process when a request takes too long and the parent has not ended it."""
    if sys.platform != "win32":
        import resource

        spent = int(time.process_time() + limit_s * (os.cpu_count() or 1) + _GRACE_S)
        most = resource.getrlimit(resource.RLIMIT_CPU)[1]  # the system's own limit, never raised
        resource.setrlimit(resource.RLIMIT_CPU, (spent if most < 0 else min(spent, most), most))
    faulthandler.dump_traceback_later(limit_s + _GRACE_S, exit=True)  # by a thread that needs no interpreter
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def _send(pipe: IO[bytes], message: bytes) -> None:
    pipe.write(_LENGTH.pack(len(message)) + message)
    pipe.flush()


def _receive(pipe: IO[bytes], limit: int) -> bytes:
    (length,) = _LENGTH.unpack(_exactly(pipe, _LENGTH.size))
    if length > limit:
        raise ValueError(f"{length} bytes where {limit} are allowed")
    return _exactly(pipe, length)


def _exactly(pipe: IO[bytes], length: int) -> bytes:
    data = pipe.read(length)
    if len(data) < length:
        raise EOFError
    return data


def _receive_array(pipe: IO[bytes], dtype: np.dtype[Any], shape: list[int]) -> NDArray[Any]:
    array = np.empty(shape, dtype)
    view = memoryview(cast(Any, array.reshape(-1).view(np.uint8)))
    while view:
        count = cast(Any, pipe).readinto(view)
        if not count:
            raise EOFError
        view = view[count:]
    return array
