"""The page of an exported GLB in a browser without network: model-viewer shows the object."""

import time
from pathlib import Path

import pytest

from polcap.errors import SettingError
from polcap.formats.export import gltf, web_page
from tests import surfaces
from tests.render import devtools

SCRIPT = devtools.MODULES / "@google" / "model-viewer" / "dist" / "model-viewer.min.js"


def test_page_shows_the_object_without_network_or_complaint(tmp_path: Path) -> None:
    if not SCRIPT.exists():
        pytest.skip("needs `npm ci` in tests/gltf")
    maps = surfaces.maps()
    options = gltf.GlbOptions("webp", "quantized")
    (tmp_path / "ball.glb").write_bytes(gltf.encode(surfaces.built(maps, surfaces.mesh(maps)), "ball", options))
    web_page.write(tmp_path / "ball.html", tmp_path / "ball.glb", web_page.read_script(SCRIPT), {"title": "a <ball>"})
    with devtools.opened() as page:
        page.call("Page.navigate", url=(tmp_path / "ball.html").as_uri())
        page.wait("document.readyState === 'complete' && innerWidth > 0")
        limit, before, red, green = time.monotonic() + devtools.LIMIT_S, 0, 0, 0
        while red == 0 or red != before:  # until the object is drawn, and no longer fades in
            assert time.monotonic() < limit, page.complaints
            time.sleep(0.5)
            seen, before = page.screenshot(), red
            red, green = ((seen[..., a] > seen[..., b] + 30).sum() for a, b in ((0, 1), (1, 0)))
        assert page.evaluate("document.title") == "a <ball>"
        assert [one for one in page.complaints if "rAF timed out" not in one] == []  # on a busy machine
        assert [one for one in page.asked if not one.startswith(("data:", "file:", "blob:"))] == []
    assert green > 2 * red > 1000  # the ball has a red quarter


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "three.js").write_text("nothing")
    for name in ("three.js", "missing.js"):
        with pytest.raises(SettingError, match=r"give model-viewer\.min\.js"):
            web_page.read_script(tmp_path / name)
