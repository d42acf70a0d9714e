"""Writes a web page on which the viewer OpenLIME shows a relightable layer; its script is in the same folder."""

from collections.abc import Mapping
from pathlib import Path
from string import Template

from polcap.formats import atomic
from polcap.formats.export import iiif, web_page

SCRIPT = "openlime.min.js"

# Color space 1 is sRGB. OpenLIME makes Ward's parameter of gloss g and limits (a, b) as (b^¼ + g (a^¼ - b^¼))⁴. Its
# light has irradiance 1 and its gamma is 2.2; the photograph has irradiance π, so the page is brighter by π^(1/2.2).
_PAGE = Template(
    """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="description" content="$description">
<title>$title</title><link rel="icon" href="data:,">
<style>
html, body { margin: 0; height: 100%; background: #000; color: #eee; font: 14px sans-serif; }
#view { position: relative; width: 100%; height: 100%; overflow: hidden; }
#view canvas, .openlime-overlay { position: absolute; top: 0; left: 0; width: 100%; height: 100%; touch-action: none; }
#view canvas { filter: brightness(1.683); }
p { position: absolute; left: 12px; bottom: 0; pointer-events: none; }
</style>
<div id="view"></div>
<p id="words">$caption. Move the pointer to move the light, drag to pan, turn the wheel to zoom.</p>
<script src="$script"></script>
<script>
'use strict';
if (!window.OpenLIME) document.getElementById('words').textContent =
  'Put the file $script of OpenLIME into the folder of this page, and serve the folder by a web server.';
else {
  const view = document.getElementById('view');
  const viewer = new OpenLIME.Viewer(view);
  const layer = new OpenLIME.Layer({
    type: 'brdf', layout: 'image', label: document.title,
    channels: { kd: 'albedo/$full', ks: 'specular/$full', normals: 'normal/$full', gloss: 'gloss/$full' },
    colorspaces: { kd: 1, ks: 1 }, alphaLimits: [0, 1], kAmbient: 0.02,
  });
  viewer.addLayer('object', layer);
  const panning = { priority: -1000, activeModifiers: [0, 1] };
  viewer.pointerManager.onEvent(new OpenLIME.ControllerPanZoom(viewer.camera, panning));
  view.addEventListener('pointermove', (event) => {
    const box = view.getBoundingClientRect(), half = Math.min(box.width, box.height) / 2;
    const x = (event.clientX - box.x - box.width / 2) / half, y = (box.y + box.height / 2 - event.clientY) / half;
    layer.setLight([x, y], 0);
  });
}
</script>
</html>
"""
)


def write(path: Path, facts: Mapping[str, str]) -> None:
    """Write the page into the folder that contains the folders of the pictures; `facts` as for `web_page.write`."""
    page = _PAGE.substitute(web_page.texts(facts), script=SCRIPT, full=iiif.FULL)
    atomic.write(path, page)
