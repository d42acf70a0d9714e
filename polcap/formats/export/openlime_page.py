"""Writes a web page, from the template `openlime_page.html`, on which OpenLIME shows a relightable layer.

The viewer's script is in the same folder. Color space 1 is sRGB. OpenLIME makes Ward's parameter of gloss g and limits
(a, b) as (b^¼ + g (a^¼ - b^¼))⁴. Its light has irradiance 1 and its gamma is 2.2; the photograph has irradiance π, so
the page is brighter by π^(1/2.2).
"""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

from polcap.formats import atomic
from polcap.formats.export import iiif, web_page

SCRIPT = "openlime.min.js"


def write(path: Path, facts: Mapping[str, str]) -> None:
    """Write the page into the folder that contains the folders of the pictures; `facts` as for `web_page.write`."""
    page = Template(files("polcap.formats.export").joinpath("openlime_page.html").read_text("utf-8"))
    atomic.write(path, page.substitute(web_page.texts(facts), script=SCRIPT, full=iiif.FULL))
