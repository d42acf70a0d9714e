"""The README's picture from a result: photograph, angle of polarization, normals, albedo, roughness, relit.

python docs/make_picture.py RESULT docs/images/first-capture.jpg
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from polcap.formats import atomic
from polcap.pipeline import run as pipeline
from polcap.report import animation, keys
from polcap.report import stage_pictures as pictures

WIDTH, GAP = 400, 8  # px
LIGHT = 6 / 48  # of the way round, from the left above

result, file = map(Path, sys.argv[1:3])
found, about = pipeline.reopen(result)
cues, maps = found.cues, found.maps
turn = np.degrees(np.arctan2(cues.normalized_stokes[1], cues.normalized_stokes[0]) / 2) % 180
relit = animation.light(maps, about["settings"]["infer"]["ior"])
inside = maps.mask[..., None]
tiles = [
    pictures.display(cues.radiance),
    keys.AOLP.picture(turn, cues.mask),
    pictures.normal(maps),
    pictures.display(maps.diffuse * inside, 1.0),
    keys.ROUGHNESS.picture(maps.roughness, maps.mask),
    relit[round((1 - LIGHT) * len(relit))],
]
height = round(WIDTH * maps.mask.shape[0] / maps.mask.shape[1])
sized = [cv2.resize(tile, (WIDTH, height), interpolation=cv2.INTER_AREA) for tile in tiles]
framed = [cv2.copyMakeBorder(tile, GAP, 0, GAP, 0, cv2.BORDER_CONSTANT, value=(255, 255, 255)) for tile in sized]
sheet = np.vstack([np.hstack(framed[:3]), np.hstack(framed[3:])])[GAP:, GAP:]
_, encoded = cv2.imencode(".jpg", np.ascontiguousarray(sheet[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 86])
with atomic.path(file) as temporary:
    temporary.write_bytes(encoded.tobytes())
