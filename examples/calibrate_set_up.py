"""A camera, lens, polarizer and flash that are known, photographed and measured again: what calibration finds.

python examples/calibrate_set_up.py FOLDER

With your own photographs only the last lines are needed; docs/how-to/calibrate.md says what to photograph.
"""

import sys
from pathlib import Path

from polcap import calibrate
from polcap.formats import calibrations
from polcap.synth import calibration_frames
from polcap.synth.calibration_frames import CalibrationShoot

folder = Path(sys.argv[1])
known = CalibrationShoot(width=192, height=128, isos=(100.0,), pops=8, zero_deg=2.5, extinction=(150.0, 200.0, 100.0))
calibration_frames.write(folder / "photographs", known)

found = calibrate.measure(folder / "photographs", made="2026-03-14T12:00:00", lens_filter="B+W KSM")
print(calibrations.write(folder, found))
print("electrons at white", found.noise[0].electrons_at_white, "in truth", known.sensor.full_well)
assert found.polarizer is not None
print("zero of the ring", found.polarizer.zero_deg, "in truth", known.zero_deg)
print("extinction", found.polarizer.extinction, "in truth", known.extinction)
