"""In: photographs of what is known. Out: a dated calibration that `process` finds by itself: `polcap calibrate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from polcap import terminal
from polcap.cli.options import Json

if TYPE_CHECKING:
    from polcap.calibration_values import Calibration


def calibrate(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(help="Folder that holds dark/, flat/, bracket/, flash/, polarizer/, lens/, or some of them."),
    ],
    lens_filter: Annotated[str, typer.Option("--filter", metavar="NAME", help="The polarizer's name.")] = "",
    axis: Annotated[
        float,
        typer.Option(
            min=-360, max=360, metavar="DEG", help="Axis of the light in polarizer/pol…, image x to image up."
        ),
    ] = 0.0,
    out: Annotated[Path | None, typer.Option(help="Folder for the file; by default the user's calibrations.")] = None,
    json: Json = False,
) -> None:
    """Measure camera, lens, polarizer and flash once; `process` and `check` use it for the same camera and lens."""
    from datetime import UTC, datetime

    import msgspec

    from polcap import calibrate as calibration
    from polcap.formats import calibrations, calibrations_folder

    made = datetime.now(UTC).isoformat(timespec="seconds")
    found = calibration.measure(folder, made, lens_filter, axis)
    path = calibrations.write(out or calibrations_folder.folder(), found)
    terminal.tell("\n".join(lines(found)))
    terminal.say({"file": str(path), "calibration": msgspec.to_builtins(found)} if json else str(path))


def lines(found: "Calibration") -> list[str]:
    """What was measured, for a person."""
    rows = [" · ".join(part for part in (found.camera, found.lens, found.filter) if part)]
    for line in found.noise:
        doubt = 100 * max(sigma / slope for sigma, slope in zip(line.slope_sigma, line.slope, strict=True))
        electrons, read = _listed(line.electrons_at_white, ".0f"), _listed(line.read_noise_electrons, ".1f")
        if line.read_noise_sigma:
            read += f" ± {max(line.read_noise_sigma):.1f}"
        source = "a bracket" if line.source == "bracket" else line.source
        said = f"{electrons} e⁻ at white ± {doubt:.1f} %, read noise {read} e⁻, from {source}"
        rows.append(f"noise      ISO {line.iso:g}: {said}")
    if (levels := found.levels) is not None:
        black, stated = _listed(levels.black, ".2f"), _listed(levels.black_stated, "g")
        white = "no frame saturates" if levels.white is None else f"white {levels.white:g}"
        rows.append(f"levels     black {black} (stated {stated}), {white} (stated {levels.white_stated:g})")
    if (curve := found.linearity) is not None:
        power = f"power {curve.power:.4f} ± {curve.power_sigma:.4f}"
        span = f"from {100 * curve.darkest:.0f} to {100 * curve.brightest:.0f} % of white"
        rows.append(f"linearity  {power}, within {100 * curve.greatest_deviation:.2f} % {span}")
    if (light := found.falloff) is not None:
        rows.append(f"falloff    corners {_listed(light.corner, '.3f')} of the middle")
    if (ring := found.polarizer) is not None:
        sense = "as the picture" if ring.sense > 0 else "the other way"
        told = f"counts {sense}" if ring.sense_known else "sense not measured: light of a second axis tells"
        doubt = max(sigma / ratio for sigma, ratio in zip(ring.extinction_sigma, ring.extinction, strict=True))
        extinction = f"extinction {_listed(ring.extinction, '.0f')} ± {100 * doubt:.0f} %"
        rows.append(f"polarizer  zero {ring.zero_deg:+.2f}° ± {ring.zero_sigma_deg:.2f}°, {told}, {extinction}")
    if (flash := found.flash) is not None:
        drift = f"drift {100 * flash.drift_per_pop:+.3f} % ± {100 * flash.drift_sigma:.3f} % a pop"
        spread = f"{100 * flash.spread:.2f} % ± {100 * flash.spread_sigma:.2f} % from pop to pop"
        rows.append(f"flash      {spread}, {drift}, {flash.pops} pops")
    return rows


def _listed(values: tuple[float, ...], form: str) -> str:
    return ", ".join(format(value, form) for value in values)
