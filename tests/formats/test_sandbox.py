"""The sandbox: a failure of the child is one error in the parent, and the next file is read."""

import importlib
import os
import subprocess
import sys
import textwrap
import time
from types import ModuleType

import numpy as np
import pytest

from polcap.errors import ChartError, DecodeError
from polcap.formats.sandbox import ChildBug, Sandbox

FUNCTIONS = """
    import os, time
    import numpy as np
    from polcap.errors import ChartError
    from polcap.formats import sandbox

    if "SHORT_GRACE" in os.environ:
        sandbox._GRACE_S = 0.2

    def ramp(path, count=12):
        print("a library chatters on stdout")
        return {"path": path, "pid": os.getpid()}, {
            "ramp": np.arange(count, dtype=np.uint16).reshape(-1, 4)[:, ::2],
            "empty": np.zeros((0, 3)),
            "bits": np.array([[True, False]]),
        }

    def crash(path):
        os.abort()

    def hang(path):
        time.sleep(600)

    def hoard(path):
        return {}, {"much": np.ones(2**29)}

    def refuse(path):
        raise ChartError(path + ": no chart")

    def spin(path):
        sum(range(10**15))  # one call into C that never releases the interpreter

    def objects(path):
        return {}, {"pointers": np.array([None])}

    def working_folder(path):
        return {"folder": os.getcwd()}, {}

    def huge(path):
        return {}, {"much": np.broadcast_to(np.uint8(0), (2**20, 2**20))}

    def much_text(path):
        return {"text": "a" * 2**23}, {}

    def mistake(path):
        raise RuntimeError("a defect")

    def answer(path, text):
        send = sandbox._send

        def send_once(pipe, message):
            sandbox._send = send
            send(pipe, text.encode())

        sandbox._send = send_once
        return {}, {}

    def stopped(path):
        os.kill(os.getpid(), 9)
"""


class Misled(Sandbox):
    """A sandbox with a module of misbehaving functions."""

    module: ModuleType


@pytest.fixture(scope="module")
def sandbox(tmp_path_factory):
    folder = tmp_path_factory.mktemp("modules")
    (folder / "misbehaving.py").write_text(textwrap.dedent(FUNCTIONS))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        sandbox = Misled(timeout_s=300, memory_gib=1.5)
        sandbox.module = importlib.import_module("misbehaving")
        yield sandbox
        sys.modules.pop("misbehaving")
        sandbox.close()


def pid(sandbox):
    return sandbox.call(sandbox.module.ramp, "next.raw")[0]["pid"]


def test_arrays_come_back_as_they_were(sandbox):
    meta, arrays = sandbox.call(sandbox.module.ramp, "a.raw", count=8)
    assert meta["path"] == "a.raw" and meta["pid"] != os.getpid()
    np.testing.assert_array_equal(arrays["ramp"], [[0, 2], [4, 6]])
    assert arrays["ramp"].dtype == np.uint16 and arrays["ramp"].flags.writeable
    assert arrays["empty"].shape == (0, 3)
    assert arrays["bits"].tolist() == [[True, False]]


def test_one_child_serves_several_files_and_follows_the_parent_into_another_folder(sandbox, tmp_path, monkeypatch):
    first = pid(sandbox)
    monkeypatch.chdir(tmp_path)
    assert sandbox.call(sandbox.module.working_folder, "a.raw")[0]["folder"] == os.getcwd()
    assert pid(sandbox) == first


def test_a_child_imports_no_modules_from_inside_a_package(sandbox, tmp_path, monkeypatch):
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "typing.py").write_text("raise ImportError('not the typing of Python')")  # as OpenCV has one
    monkeypatch.setattr(sys, "path", [str(package), *sys.path])
    sandbox.close()
    assert sandbox.call(sandbox.module.ramp, "next.raw")[0]["path"] == "next.raw"


@pytest.mark.parametrize(
    ("function", "limit_s", "message"),
    [
        ("crash", None, "the decoder crashed"),
        ("hang", 0.5, r"not decoded within 0\.5 s"),  # of the decoding: however long the child takes to start
        ("hoard", None, "memory"),
        ("objects", None, "damaged"),
        ("huge", None, "damaged"),
        ("much_text", None, "damaged"),
        ("stopped", None, "the system ended the decoder, most often for lack of memory"),
    ],
)
def test_a_failure_names_the_file_and_the_next_file_is_read(sandbox, function, limit_s, message):
    with pytest.raises(DecodeError, match=rf"broken\.raw: .*{message}"):
        sandbox.call(getattr(sandbox.module, function), "broken.raw", limit_s=limit_s)
    assert pid(sandbox)


ARRAYS = ('"a"', '"a", "<u2", [1.5]', f'"a", "<u2", [0, {2**70}]', '"a", "nothing", [1]', '"a", "f4,(", [1]')


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", "[" * 10**5, '{"error": 1}', '{"meta": []}']
    + [f'{{"meta": {{}}, "arrays": [[{one}]]}}' for one in ARRAYS],
)
def test_a_malformed_answer_is_an_error_of_the_file(sandbox, text):
    with pytest.raises(DecodeError, match=r"broken\.raw: the decoder's answer is damaged"):
        sandbox.call(sandbox.module.answer, "broken.raw", text=text)
    assert pid(sandbox)


def test_an_error_of_the_function_keeps_its_class_if_any_and_its_child(sandbox):
    before = pid(sandbox)
    with pytest.raises(ChartError, match=r"^a\.raw: no chart$"):
        sandbox.call(sandbox.module.refuse, "a.raw")
    assert pid(sandbox) == before
    with pytest.raises(DecodeError, match=r"broken\.raw: no picture"):
        sandbox.call(sandbox.module.answer, "broken.raw", text='{"error": "no picture"}')


def test_a_defect_of_our_own_is_a_bug_with_the_childs_traceback(sandbox):
    with pytest.raises(ChildBug, match=r"odd\.raw: RuntimeError: a defect") as caught:
        sandbox.call(sandbox.module.mistake, "odd.raw")
    assert 'raise RuntimeError("a defect")' in caught.value.__notes__[0]
    assert pid(sandbox)


@pytest.mark.parametrize("loop", ["spin", "hang"])
def test_a_child_in_a_loop_ends_when_its_parent_was_killed(sandbox, loop):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import misbehaving\n"
        "from polcap.formats.sandbox import Sandbox\n"
        "w = Sandbox(); print(w.call(misbehaving.ramp, 'a')[0]['pid'], flush=True)\n"
        f"w.call(misbehaving.{loop}, 'b', limit_s=2)"
    )
    command = [sys.executable, "-c", code, os.path.dirname(sandbox.module.__file__)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "SHORT_GRACE": ""})
    child = int(parent.stdout.readline())
    time.sleep(0.3)  # it is in the loop
    parent.kill()
    parent.wait()
    parent.stdout.close()
    for _ in range(2000):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the child outlived its parent")
