"""A function and a path in, its arrays out: untrusted files are read in a child process.

C libraries crash, hang and eat memory on damaged files. Here they may: the child is a
fresh interpreter (never a fork, so that no OpenMP state is copied), kept for the next
file, limited in time and memory, and it ends when its parent does, even amid a loop.
Its death is one `DecodeError` that names the file. What it answers is bounded and holds
numbers only, so a child that a file has taken over gains nothing from its parent.
An exception that is no `InputError` is a defect of polcap: `ChildBug`, with the child's traceback.
Arrays come back as raw bytes over the pipe, read straight into their final memory.
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
import time
import traceback
from collections.abc import Callable, Iterator
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from polcap import errors

START_S = 300.0  # until a child has begun; about a second, but not on a machine that is busy with all else
TIMEOUT_S = 180.0  # from then on; a 150 MP compressed frame takes about 6 s
MEMORY_GIB = 8.0  # address space of the child
_HEAD_BYTES = 4 << 20  # of an answer without its arrays; the tags of a photograph make a few kB
_LOG_BYTES = 1 << 16  # of what a child has printed, read at its death
_GRACE_S = 5.0  # by which the child's own clock is later than its parent's

Arrays = dict[str, NDArray[Any]]
Answer = tuple[dict[str, Any], Arrays]
_LENGTH = struct.Struct("<Q")
_BEGUN = b"begun"  # the child has started and imported what it needs: from now on its time counts
_START = (
    "import sys; sys.path[:] = sys.argv[3:]; from polcap.formats.raw import worker; "
    "worker.serve(float(sys.argv[1]), int(sys.argv[2]))"
)


class ChildBug(RuntimeError):
    """A defect of polcap's own code that runs in the child; exit code 1. Its note is the child's traceback."""


class Worker:
    """A child process that runs one function on one file at a time; restarts when it dies."""

    def __init__(self, timeout_s: float = TIMEOUT_S, memory_gib: float = MEMORY_GIB) -> None:
        self.timeout_s = timeout_s
        self.memory_gib = memory_gib
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._lifeline: int | None = None  # the end of a pipe that closes with this process

    def call(
        self,
        function: Callable[..., Answer],
        path: str | os.PathLike[str],
        *,
        limit_s: float | None = None,
        limit_gib: float | None = None,
        **options: Any,
    ) -> Answer:
        """Run `function(path, **options)` in the child.

        Parameters
        ----------
        function
            Of a module's top level; the child imports it.
        path
            Its first argument.
        limit_s, limit_gib
            Tighter limits than the worker's, for what takes little of a sound file; memory beyond the idle child's.
        options
            Plain JSON values.

        Raises
        ------
        DecodeError
            The function refused the file, crashed, ran past its time or out of memory.
        ChildBug
            The function failed in a way that no file may cause.
        """
        limit = min(self.timeout_s, limit_s or self.timeout_s)
        request = {
            "module": function.__module__,
            "name": function.__qualname__,
            "path": os.fspath(path),
            "options": options,
            "limit_s": limit,
            "limit_gib": limit_gib,
        }
        with self._lock:
            child = self._child if self._child and self._child.poll() is None else self._spawn()
            slow, overdue = threading.Event(), threading.Event()
            try:
                with _killed_after(START_S, child, slow):
                    _send(cast(IO[bytes], child.stdin), json.dumps(request).encode())
                    _receive(cast(IO[bytes], child.stdout), len(_BEGUN))
                with _killed_after(limit, child, overdue):
                    head, arrays = self._answer(cast(IO[bytes], child.stdout))
            except (EOFError, OSError):
                code = child.wait()
                if slow.is_set():
                    name = os.fspath(path)
                    raise errors.DecodeError(f"{name}: no decoder began within {START_S:g} s; run again") from None
                gib = limit_gib or self.memory_gib
                raise errors.DecodeError(self._cause_of_death(path, code, limit, gib, overdue.is_set())) from None
            except (ValueError, TypeError, KeyError) as error:
                self._stop()
                raise errors.DecodeError(f"{os.fspath(path)}: the decoder's answer is damaged ({error})") from error
            except BaseException:  # Ctrl-C amid an answer: the pipe is no longer in step
                self._stop()
                raise
        if "bug" in head:
            bug = ChildBug(f"{os.fspath(path)}: {head['bug']}")
            bug.add_note(str(head["traceback"]))
            raise bug
        if "error" in head:
            kind = getattr(errors, str(head.get("kind")), None)
            if isinstance(kind, type) and issubclass(kind, errors.InputError):
                raise kind(head["error"])
            raise errors.DecodeError(f"{os.fspath(path)}: {head['error']}")
        if "meta" not in head:
            raise errors.DecodeError(f"{os.fspath(path)}: the decoder's answer is damaged (it says nothing)")
        return head["meta"], arrays

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._stop()

    def _answer(self, pipe: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
        """What the child sends, no larger than it may be."""
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
        with contextlib.suppress(OSError):  # no place for temporary files: do without the child's last words
            self._log = tempfile.TemporaryFile()  # noqa: SIM115 — read at the child's death, closed in _stop
        ours, theirs = _lifeline()
        try:
            self._child = subprocess.Popen(
                [sys.executable, "-c", _START, str(self.memory_gib), str(theirs), *_module_folders()],
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

    def _cause_of_death(
        self, path: str | os.PathLike[str], code: int, limit_s: float, gib: float, overdue: bool
    ) -> str:
        name = os.fspath(path)
        if overdue or code == -_signal("SIGXCPU"):
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
    """Kill the child, and say so, when this takes too long."""
    timer = threading.Timer(limit_s, _kill, (child, overdue))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _kill(child: subprocess.Popen[bytes], overdue: threading.Event) -> None:
    overdue.set()
    child.kill()


def _module_folders() -> list[str]:
    """`sys.path` without the insides of packages: OpenCV's stands there while another thread imports it.

    From there a child would take OpenCV's `typing` for Python's.
    """
    return [folder for folder in sys.path if not os.path.isfile(os.path.join(folder, "__init__.py"))]


def _lifeline() -> tuple[int | None, int]:
    """A pipe that nobody writes to: our end, and the child's, -1 where a child cannot take one over."""
    if os.name != "posix":
        return None, -1
    theirs, ours = os.pipe()
    return ours, theirs


def _signal(name: str) -> int:
    import signal

    return int(getattr(signal, name, 0))


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
    """`Worker.call` on a child that is idle, or on a new one: as many as threads call at a time.

    Parameters
    ----------
    function, path, limit_s, limit_gib, options
        As in `Worker.call`.
    """
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
    """End the children that wait for a file; the next call starts one."""
    for worker in _idle:
        worker.close()


def serve(memory_gib: float, lifeline: int) -> None:
    """Answer requests on stdin until it closes. Runs in the child only."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not fall into the answers
    _die_with_parent(lifeline)
    _limit(memory_gib)
    while True:
        try:
            request = json.loads(_receive(requests, _HEAD_BYTES))
        except EOFError:
            return
        with contextlib.suppress(Exception):  # told as the answer
            importlib.import_module(request["module"])
        _send(answers, _BEGUN)
        with _time_limit(request["limit_s"]), _memory_limit(request["limit_gib"]):
            head, arrays = _run(request, request["limit_gib"] or memory_gib)
        _send(answers, json.dumps(head).encode())
        for array in arrays.values():
            answers.write(np.ascontiguousarray(array).data)
        answers.flush()
        head, arrays = {}, {}  # an idle child holds no picture


def _run(request: dict[str, Any], memory_gib: float) -> tuple[dict[str, Any], Arrays]:
    """The answer to one request, whatever becomes of it."""
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
    """Let the kernel end this process when the other end of the pipe closes, whatever runs here."""
    if sys.platform == "win32" or lifeline < 0:
        return
    import fcntl

    with contextlib.suppress(OSError):  # where a pipe knows no such signal, the time limit ends a loop
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)


def _limit(memory_gib: float) -> None:
    if sys.platform == "win32":  # no such limits there; the time limit still holds
        return
    import resource

    size = int(memory_gib * 2**30)
    with contextlib.suppress(ValueError, OSError):  # macOS refuses RLIMIT_AS; a tighter limit may already stand
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


@contextlib.contextmanager
def _memory_limit(more_gib: float | None) -> Iterator[None]:
    """Let a request take no more memory than this beyond what is taken; where the kernel tells how much."""
    if more_gib is None or not sys.platform.startswith("linux"):
        yield
        return
    import resource

    with open("/proc/self/statm", encoding="ascii") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    usual = resource.getrlimit(resource.RLIMIT_AS)
    size = taken + int(more_gib * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (size if usual[0] < 0 else min(size, usual[0]), usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, usual)


@contextlib.contextmanager
def _time_limit(limit_s: float) -> Iterator[None]:
    """End this process when a request takes too long, should the parent not have done so."""
    if sys.platform != "win32":
        import resource

        spent = int(time.process_time() + limit_s * (os.cpu_count() or 1) + _GRACE_S)
        most = resource.getrlimit(resource.RLIMIT_CPU)[1]  # of the machine's owner: never raised
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
