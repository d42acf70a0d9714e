"""The decode worker: whatever happens in the child is one error here, and the next file is read."""

import os
import textwrap
import time

import numpy as np
import pytest

from polcap.errors import ChartError, DecodeError
from polcap.formats.worker import Worker

FUNCTIONS = """
    import os, time
    import numpy as np
    from polcap.errors import ChartError

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
        time.sleep(60)

    def hoard(path):
        return {}, {"much": np.ones(2**29)}

    def refuse(path):
        raise ChartError(path + ": no chart")

    def mistake(path):
        raise RuntimeError("a defect")
"""


@pytest.fixture
def worker(tmp_path, monkeypatch):
    (tmp_path / "misbehaving.py").write_text(textwrap.dedent(FUNCTIONS))
    monkeypatch.syspath_prepend(tmp_path)
    worker = Worker(timeout_s=20, memory_gib=1.5)
    yield worker
    worker.close()


def pid(worker):
    return worker.call("misbehaving:ramp", "next.raw")[0]["pid"]


def test_arrays_come_back_as_they_were(worker):
    meta, arrays = worker.call("misbehaving:ramp", "a.raw", count=8)
    assert meta["path"] == "a.raw" and meta["pid"] != os.getpid()
    np.testing.assert_array_equal(arrays["ramp"], [[0, 2], [4, 6]])
    assert arrays["ramp"].dtype == np.uint16 and arrays["ramp"].flags.writeable
    assert arrays["empty"].shape == (0, 3)
    assert arrays["bits"].tolist() == [[True, False]]


def test_child_is_kept_for_the_next_file(worker):
    assert pid(worker) == pid(worker)


def test_crash_names_the_file_and_the_next_file_is_read(worker):
    before = pid(worker)
    with pytest.raises(DecodeError, match=r"broken\.raw: the decoder crashed"):
        worker.call("misbehaving:crash", "broken.raw")
    assert pid(worker) != before


def test_hang_ends_at_the_time_limit_and_the_next_file_is_read(worker):
    pid(worker)  # started, so that only the hang is timed
    worker.timeout_s = 0.5
    start = time.monotonic()
    with pytest.raises(DecodeError, match=r"slow\.raw: not decoded within 0\.5 s"):
        worker.call("misbehaving:hang", "slow.raw")
    assert time.monotonic() - start < 10
    worker.timeout_s = 20
    assert pid(worker)


def test_memory_beyond_the_limit_is_refused_and_the_next_file_is_read(worker):
    with pytest.raises(DecodeError, match=r"huge\.raw.*memory"):
        worker.call("misbehaving:hoard", "huge.raw")
    assert pid(worker)


def test_an_error_of_the_function_keeps_its_class_and_its_child(worker):
    before = pid(worker)
    with pytest.raises(ChartError, match=r"^a\.raw: no chart$"):
        worker.call("misbehaving:refuse", "a.raw")
    assert pid(worker) == before


def test_a_defect_is_told_with_its_reason(worker):
    with pytest.raises(DecodeError, match=r"odd\.raw.*RuntimeError: a defect"):
        worker.call("misbehaving:mistake", "odd.raw")


def test_fifty_megabytes_cross_in_less_time_than_they_take_to_decode(worker):
    pid(worker)
    start = time.monotonic()
    _, arrays = worker.call("misbehaving:ramp", "large.raw", count=50_000_000)  # 50 MB of every other column
    assert arrays["ramp"].nbytes == 50_000_000
    assert time.monotonic() - start < 2.0  # measured 0.15 s on an idle core
