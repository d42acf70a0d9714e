"""The import of colour-science leaves no trace."""

import os
import subprocess
import sys


def test_import_is_silent_writes_nothing_and_leaves_no_mock_modules(tmp_path):
    code = (
        "import sys, unittest.mock\n"
        "import polcap.optics.colour_science\n"
        "print([name for name, module in sys.modules.items() if isinstance(module, unittest.mock.MagicMock)])\n"
        "print('matplotlib' in sys.modules)"
    )
    places = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "TMPDIR"), str(tmp_path))
    path = os.pathsep.join(place for place in sys.path if place)
    done = subprocess.run(
        [sys.executable, "-B", "-W", "always::UserWarning", "-c", code],
        cwd=tmp_path, env={**os.environ, **places, "PYTHONPATH": path}, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("[]\nFalse\n", "")
    assert not list(tmp_path.iterdir())
