"""The README's picture from a result: photograph, maps and relit object in labeled panels.

python docs/make_picture.py RESULT docs/images/first-capture.jpg
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from polcap.formats import atomic
from polcap.pipeline import run as pipeline
from polcap.report import animation, keys, sheets
from polcap.report import stage_pictures as pictures
from polcap.results import Results

WIDTH, HEAD, GAP, ROW = 300, 30, 8, 4  # px of a panel, its label and the gaps; panels in a row
LIGHT = 6 / 48  # of the way round, from the left above

result, file = map(Path, sys.argv[1:3])
found, about = pipeline.reopen(result, Results)
maps, depth = found.maps, found.mesh.depth
relit = animation.light(maps, about["settings"]["infer"]["ior"])
key = keys.depth(depth[np.isfinite(depth)], metric=False)
panels = {
    "Photograph": pictures.display(found.cues.radiance),
    "Normals": pictures.normal(maps),
    "Depth": pictures.cut_out(key.picture(depth, maps.mask), maps.mask & np.isfinite(depth)),
    "Expected error": pictures.cut_out(keys.ERROR.picture(maps.confidence, maps.mask), maps.mask),
    "Diffuse albedo": pictures.cut_out(pictures.display(maps.diffuse, 1.0), maps.mask),
    "Specular albedo": pictures.cut_out(pictures.display(maps.specular, keys.F0.high), maps.mask),
    "Roughness": pictures.cut_out(keys.ROUGHNESS.picture(maps.roughness, maps.mask), maps.mask),
    "Relit from the left": relit[round((1 - LIGHT) * len(relit))],
}
height = round(WIDTH * maps.mask.shape[0] / maps.mask.shape[1])
framed = []
for label, panel in panels.items():
    tile = np.full((HEAD + height + GAP, WIDTH + GAP, 3), 255, np.uint8)
    tile[HEAD:-GAP, :-GAP] = cv2.resize(panel, (WIDTH, height), interpolation=cv2.INTER_AREA)
    sheets.write(tile, label, (2, 22), (30, 32, 36), 18)
    framed.append(tile)
sheet = np.vstack([np.hstack(framed[start : start + ROW]) for start in range(0, len(framed), ROW)])[:-GAP, :-GAP]
_, encoded = cv2.imencode(".jpg", np.ascontiguousarray(sheet[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 86])
with atomic.path(file) as temporary:
    temporary.write_bytes(encoded.tobytes())
