"""Writes a web page that shows a GLB with model-viewer, from the template `web_page.html`.

The page contains the GLB and the script, and may load nothing else; so it works without the Internet.
"""

import base64
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from polcap.errors import SettingError
from polcap.formats import atomic, text_file

_SHOWN = ("object_number", "date", "institution", "creator", "rights", "license")  # in the caption, after the title


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
    page = Template(files("polcap.formats.export").joinpath("web_page.html").read_text("utf-8"))
    content, script = base64.b64encode(glb.read_bytes()).decode(), script.replace("</script", "<\\/script")
    atomic.write(path, page.substitute(texts(facts), glb=content, script=script))
