"""Writes a web page that shows a GLB with model-viewer; both are in the page, so it works without a network."""

import base64
from collections.abc import Mapping
from html import escape
from pathlib import Path
from string import Template

from polcap.errors import SettingError
from polcap.formats import atomic, text_file

_SHOWN = ("object_number", "date", "institution", "creator", "rights", "license")
# the page may load nothing but its own parts
_PAGE = Template(
    """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval';
 style-src 'unsafe-inline'; img-src data: blob:; connect-src data: blob:; worker-src blob:">
<meta name="description" content="$description">
<title>$title</title>
<style>
html, body { margin: 0; height: 100%; font: 14px sans-serif; background: #eee; }
model-viewer { width: 100%; height: 100%; }
p { position: absolute; left: 12px; bottom: 4px; margin: 0; color: #333; pointer-events: none; }
</style>
<model-viewer src="data:model/gltf-binary;base64,$glb" alt="$title" camera-controls touch-action="pan-y"
 tone-mapping="neutral" shadow-intensity="1"></model-viewer>
<p>$caption</p>
<script type="module">$script</script>
</html>
"""
)


def texts(facts: Mapping[str, str]) -> dict[str, str]:
    """Title, caption and description of a page on an object, as HTML; `facts` as for `write`."""
    title = facts.get("title") or facts["name"]
    caption = " · ".join([title, *(facts[name] for name in _SHOWN if facts.get(name))])
    return {"title": escape(title), "caption": escape(caption), "description": escape(facts.get("description", ""))}


def read_script(file: Path) -> str:
    """The text of model-viewer.min.js. Raises SettingError: the file cannot be read, or is not model-viewer."""
    try:
        script = text_file.read_text(file)
    except (OSError, ValueError) as error:
        raise SettingError(f"--page {file} cannot be read ({error}); give model-viewer.min.js") from error
    if "model-viewer" not in script:
        raise SettingError(f"--page {file} is not model-viewer; give model-viewer.min.js of @google/model-viewer")
    return script


def write(path: Path, glb: Path, script: str, facts: Mapping[str, str]) -> None:
    """Write the page of a GLB without Draco, with the text of model-viewer's script.

    `facts` are fields of `CatalogEntry` and the capture's `name`; the page shows them.
    """
    page = _PAGE.substitute(
        texts(facts), glb=base64.b64encode(glb.read_bytes()).decode(), script=script.replace("</script", "<\\/script")
    )
    atomic.write(path, page)
