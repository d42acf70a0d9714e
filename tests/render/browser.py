"""Three.js in a headless Chromium, asked through a local web server that lives for one call."""

import base64
import json
import queue
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

from polcap.formats.export import gltf
from polcap.image_values import Floats, View
from polcap.mesh_values import ReliefMesh

HERE = Path(__file__).parent
MODULES = HERE.parent / "gltf" / "node_modules"
BROWSERS = ("chromium", "chromium-browser", "chromium-headless-shell", "google-chrome")
LIMIT_S = 400


@dataclass(frozen=True)
class Job:
    """One file seen through the camera of its photograph; a light is a direction to it, None is everywhere."""

    name: str
    file: Path
    mesh: ReliefMesh
    view: View
    lights: tuple[tuple[float, float, float] | None, ...]


def find() -> str:
    """The browser's path; skips the test where there is none."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("needs a Chromium")
    return browser


def require() -> str:
    """The same; skips the test where three.js is missing, too."""
    browser = find()
    if not (MODULES / "three").is_dir():
        pytest.skip("needs `npm ci` in tests/gltf")
    return browser


def render(folder: Path, jobs: list[Job]) -> dict[str, list[Floats]]:
    """Linear pictures (H, W, 3) of each job, on the grid of its maps; `folder` holds the files."""
    browser = require()
    (folder / "jobs.json").write_text(json.dumps([_described(job, folder) for job in jobs]))
    shutil.copy(HERE / "page.html", folder / "page.html")
    answers: queue.Queue[dict[str, Any]] = queue.Queue()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, answers=answers, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as profile:
        command = [
            browser, "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", f"--user-data-dir={profile}", "--no-first-run",
            "--remote-debugging-port=0", f"http://127.0.0.1:{server.server_port}/page.html",
        ]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            answer = answers.get(timeout=LIMIT_S)
        except queue.Empty:
            pytest.fail(f"the browser gave no answer within {LIMIT_S} s")
        finally:
            end(process)
            server.shutdown()
    assert "error" not in answer, answer["error"]
    return {job.name: [_picture(text, job) for text in answer[job.name]] for job in jobs}


def end(process: "subprocess.Popen[bytes]") -> None:
    """End a browser, which on a busy machine takes its time."""
    process.terminate()
    try:
        process.wait(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _described(job: Job, folder: Path) -> dict[str, Any]:
    height, width = job.mesh.depth.shape
    camera = {
        "focal": job.view.focal,
        "center": job.view.center,
        "size": [width, height],
        "position": [float(-x) for x in gltf.center(job.mesh.vertices)],
    }
    file = "/" + job.file.relative_to(folder).as_posix()
    return {"name": job.name, "file": file, "camera": camera, "lights": job.lights}


def _picture(text: str, job: Job) -> Floats:
    height, width = job.mesh.depth.shape
    pixels = np.frombuffer(base64.b64decode(text), dtype=np.uint8).reshape(height, width, 4)
    return pixels[::-1, :, :3] / 255.0  # WebGL counts rows from below


class _Handler(SimpleHTTPRequestHandler):
    def __init__(self, *args: Any, answers: queue.Queue[dict[str, Any]], **kwargs: Any) -> None:
        self.answers = answers
        super().__init__(*args, **kwargs)

    def translate_path(self, path: str) -> str:
        if path.startswith("/node_modules/"):
            return str(MODULES / path.removeprefix("/node_modules/").split("?")[0])
        return super().translate_path(path)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(204)
        self.end_headers()
        self.answers.put(json.loads(body))

    def log_message(self, *_: Any) -> None:
        pass
