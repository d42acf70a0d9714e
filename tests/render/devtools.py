"""A page in a headless Chromium, driven over the DevTools protocol by a pipe; what it logged and asked for."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
import pytest

MODULES = Path(__file__).parents[1] / "gltf" / "node_modules"
BROWSERS = ("chromium", "chromium-browser", "chromium-headless-shell", "google-chrome")
LIMIT_S = 400


def find() -> str:
    """The browser's path; skips the test where there is none."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("needs a Chromium")
    return browser


class Page:
    """One tab. `complaints` gathers console errors, exceptions and failed loads; `asked` every address asked for."""

    def __init__(self, send: int, receive: int) -> None:
        self.send, self.receive = send, receive
        self.waiting = b""
        self.count = 0
        self.session: str | None = None
        self.complaints: list[str] = []
        self.asked: list[str] = []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer of one command; events that come before it are noted."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.send, json.dumps(message).encode() + b"\0")
        limit = time.monotonic() + LIMIT_S
        while time.monotonic() < limit:
            answer = self._next()
            if answer.get("id") == self.count:
                assert "error" not in answer, answer["error"]
                return dict(answer["result"])
            self._note(answer)
        raise TimeoutError(method)

    def evaluate(self, script: str) -> Any:
        """The value of an expression in the page; promises are waited for."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def open(self, file: Path, width: int, height: int, dark: bool = False) -> None:
        """Load a file at a size of window, and wait until its scripts have said that they are ready."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=scheme)
        self.call("Page.navigate", url=file.as_uri())
        self.wait("document.documentElement?.dataset.ready || ''")

    def wait(self, condition: str) -> None:
        """Wait until an expression in the page is true."""
        limit = time.monotonic() + LIMIT_S
        while not self.evaluate(condition):
            assert time.monotonic() < limit, (condition, self.complaints)
            time.sleep(0.05)

    def screenshot(self) -> np.ndarray:
        """The whole page, not only what the window shows, (H, W, 3) 0…255."""
        return _decoded(self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)["data"])

    def canvas(self, name: str) -> np.ndarray:
        """The pixels of a canvas as it is drawn now, (H, W, 3) 0…255."""
        return _decoded(self.evaluate(f"({name}.draw(), {name}.canvas.toDataURL().split(',')[1])"))

    def pdf(self) -> bytes:
        return base64.b64decode(self.call("Page.printToPDF", printBackground=True)["data"])

    def move(self, x: float, y: float, kind: str = "mouseMoved") -> None:
        """The pointer to a place of the window, px."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left" if kind != "mouseMoved" else "none")

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.waiting:
            part = os.read(self.receive, 1 << 20)
            assert part, "the browser is gone"
            self.waiting += part
        message, _, self.waiting = self.waiting.partition(b"\0")
        return dict(json.loads(message))

    def _note(self, event: dict[str, Any]) -> None:
        method, about = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.complaints.append(str(about["exceptionDetails"].get("exception", about)))
        elif method == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning", "assert"):
            self.complaints.append(str(about["args"]))
        elif method == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            self.complaints.append(str(about["entry"]["text"]))
        elif method == "Network.requestWillBeSent":
            self.asked.append(str(about["request"]["url"])[:80])


def _decoded(png: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(png), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1].astype(float)


@contextmanager
def opened() -> Iterator[Page]:
    """A tab without network, WebGL by software; the test is skipped where there is no Chromium."""
    command = [
        find(), "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--no-first-run", "--remote-debugging-pipe", "--hide-scrollbars",
    ]  # fmt: skip
    to_browser, from_browser = os.pipe(), os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{to_browser[0]} 4>&{from_browser[1]}', "-", *command,
             f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(to_browser[0], from_browser[1]), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser[0])
        os.close(from_browser[1])
        page = Page(to_browser[1], from_browser[0])
        try:
            tabs = page.call("Target.getTargets")["targetInfos"]
            target = next(tab["targetId"] for tab in tabs if tab["type"] == "page")
            page.session = page.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Runtime", "Log", "Network", "Page"):
                page.call(f"{domain}.enable")
            offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
            page.call("Network.emulateNetworkConditions", **offline)
            yield page
        finally:
            process.terminate()
            try:
                process.wait(timeout=60)  # on a busy machine it takes its time
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            os.close(to_browser[1])
            os.close(from_browser[0])


@contextmanager
def visited(address: str) -> Iterator[Page]:
    """A page of a server of this machine."""
    with opened() as page:
        page.call(
            "Network.emulateNetworkConditions",
            offline=False, latency=0, downloadThroughput=-1, uploadThroughput=-1,
        )  # fmt: skip
        page.call("Emulation.setDeviceMetricsOverride", width=900, height=600, deviceScaleFactor=1, mobile=False)
        page.call("Page.navigate", url=address)
        yield page


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder on a web server of its own, which also has /node_modules."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


class _Handler(SimpleHTTPRequestHandler):
    def translate_path(self, path: str) -> str:
        if path.startswith("/node_modules/"):
            return str(MODULES / path.removeprefix("/node_modules/").split("?")[0])
        return super().translate_path(path)

    def log_message(self, *_: object) -> None:
        pass
