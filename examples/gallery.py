"""One page of many results: photograph, normals, shape, and a light that goes round. gallery.py PAGE.html RESULT…"""

import sys
from base64 import b64encode
from html import escape
from os.path import relpath
from pathlib import Path

from polcap import report
from polcap.formats import html
from polcap.pipeline import run as pipeline
from polcap.report import stage_pictures as pictures
from polcap.report.page import verdict
from polcap.results import Results

page, *folders = map(Path, sys.argv[1:])


def picture(address: str, words: str) -> str:
    return f'<figure><div class="picture"><img alt="{words}" src="{address}"></div>{words}</figure>'


body = ["<h1>Gallery</h1><p>From nine photographs each. A report lies beside every result.</p>"]
for folder in folders:
    results, _ = pipeline.reopen(folder, Results)
    maps, mesh, about = results.maps, results.mesh, report.read(folder)
    moving = pipeline.animate(folder, "light")[0].read_bytes()
    name, says = escape(about["capture"]["name"]), escape(" ".join(verdict(about)))
    shown = [
        (html.jpeg(pictures.display(results.cues.radiance)), "photograph"),
        (html.jpeg(pictures.normal(maps)), "normals"),
        (html.jpeg(pictures.shaded(mesh, maps)), "shape"),
        (f"data:image/webp;base64,{b64encode(moving).decode()}", "relit"),
    ]
    link = escape(relpath(folder / "report.html", page.parent))
    body.append(f'<h2><a href="{link}">{name}</a></h2><p>{says}</p><div class="grid" id="maps">')
    body.extend(picture(address, words) for address, words in shown)
    body.append("</div>")
html.write(page, "polcap gallery", body, {})
print(page)
