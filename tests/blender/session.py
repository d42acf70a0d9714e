"""Blender asked through its Python package, in a process and, where needed, an environment of its own.

bpy wants one exact Python: $POLCAP_BPY names the interpreter that has it (`python3.11 -m venv V;
V/bin/pip install bpy==5.0.1; export POLCAP_BPY=V/bin/python`).
"""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.image_values import Floats

HERE = Path(__file__).parent
LIMIT_S = 300


def require() -> str:
    """The interpreter that has bpy; skips the test where there is none."""
    named = os.environ.get("POLCAP_BPY")
    if named:
        return named
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("needs Blender's bpy: name an interpreter that has it in $POLCAP_BPY")
    return sys.executable


def ask(folder: Path, files: list[Path], **job: Any) -> list[dict[str, Floats]]:
    """What Blender finds in each file: `inside.py` tells the keys of a job and of the answer."""
    note = folder / "job.json"
    settings = {
        "bake": None,
        "camera": None,
        "lights": [],
        "lamp": "SUN",
        "samples": 16,
        **job,
        "files": [str(file) for file in files],
    }
    note.write_text(json.dumps(settings))
    run(HERE / "inside.py", note)
    with np.load(note.with_suffix(".npz")) as answer:
        every = {name: answer[name] for name in answer.files}
    return [
        {name.partition("/")[2]: value for name, value in every.items() if name.startswith(f"{number}/")}
        for number in range(len(files))
    ]


def run(script: Path, *arguments: object) -> str:
    """A script in Blender's Python; what it printed."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [require(), str(script), *map(str, arguments)], capture_output=True, text=True, timeout=LIMIT_S, env=environment
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout + done.stderr
