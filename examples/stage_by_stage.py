"""The stages one by one: from the photographs of a capture to cues and normals, without a result folder.

python examples/stage_by_stage.py CAPTURE
"""

import sys

import numpy as np

import polcap
from polcap.formats import onnx, shipped_data
from polcap.formats.raw import frame_decoder
from polcap.pipeline import models
from polcap.stages import align, cues, hdr, infer, mask, selfcal, stokes, surface, whitebalance

capture, settings = polcap.read_capture(sys.argv[1]), polcap.load_config()
patches = shipped_data.colorchecker(settings.whitebalance.chart)

radiance = hdr.merge(capture, frame_decoder.decode, settings.hdr)  # .value (K, H, W, 3): one picture per angle
color = whitebalance.measure(radiance, patches, polcap.ChartRequest("auto"), settings.whitebalance)
alignment = align.register(radiance, settings.align)
found = mask.segment(radiance, alignment, color, None, models.load_mask_network(), onnx.run, settings.mask)
calibration = selfcal.solve(radiance, alignment, found, color, settings.selfcal)
image = stokes.solve(radiance, alignment, calibration, found, settings.stokes)  # .stokes (3, H, W, 3)
seen = cues.compute(image, color, calibration.other_orders)
maps = infer.estimate(seen, models.load_network(None, None), onnx.run, settings.infer)
mesh = surface.integrate(maps, None, settings.surface)  # None: the distance is unknown, so depth is relative

print("exposures and angles:", radiance.value.shape, np.degrees(radiance.angle).round(1))
print("angles with the ring's correction:", np.degrees(calibration.angle).round(2))
print("DoLP, median:", f"{np.median(seen.dolp[image.mask]):.3f}")
print("1σ of S1/S0, median:", f"{np.median(seen.ratio_sigma[seen.mask]):.2g}")
print("normal at the middle:", maps.normal[tuple(np.argwhere(maps.mask).mean(0).astype(int))].round(2))
print("expected error, median:", f"{np.median(maps.confidence[maps.mask]):.1f}°; vertices: {len(mesh.vertices)}")
