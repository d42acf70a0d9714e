"""`polcap calibrate`: measure camera, lens, polarizer and flash from calibration photographs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import Json
from polcap.errors import SettingError

if TYPE_CHECKING:
    from polcap.calibration_values import Calibration


def calibrate(
    folder: Annotated[Path, Argument(help="Folder with some of dark/, flat/, bracket/, flash/, polarizer/, lens/.")],
    lens_filter: Annotated[str, Option("--filter", metavar="NAME", help="The polarizer's name.")] = "",
    axis: Annotated[
        float,
        Option(min=-360, max=360, metavar="DEG", help="Axis of the light in polarizer/pol…, image x to image up."),
    ] = 0.0,
    board: Annotated[str, Option(metavar="AxB", help="Inner corners of the board in lens/, across and down.")] = "9x6",
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for the file; by default the user's calibrations.")
    ] = None,
    json: Json = False,
) -> None:
    """Measure camera, lens, polarizer and flash once; `process` and `check` use it for the same camera and lens."""
    from datetime import UTC, datetime

    import msgspec

    from polcap import calibrate as calibration
    from polcap.formats import calibrations, own_folders

    options.check_out(out)
    made = datetime.now(UTC).isoformat(timespec="seconds")
    found = calibration.measure(folder, made, options.utf8("--filter", lens_filter), axis, parse_board(board))
    path = calibrations.write(out or own_folders.calibrations(), found)
    terminal.print_progress("\n".join(lines(found)))
    terminal.print_data({"file": str(path), "calibration": msgspec.to_builtins(found)} if json else str(path))


def parse_board(board: str) -> tuple[int, int]:
    """Parse the size of a checkerboard, such as `9x6`, as two numbers. Raises SettingError."""
    across, _, down = board.partition("x")
    if not (across.isdecimal() and down.isdecimal() and 3 <= int(across) <= 99 and 3 <= int(down) <= 99):
        raise SettingError(f"--board {board}: give the inner corners across and down, 3 to 99 each, such as 9x6")
    return int(across), int(down)


def lines(found: "Calibration") -> list[str]:
    """A calibration's measurements as lines of text."""
    rows = [" · ".join(part for part in (found.camera, found.lens, found.filter) if part)]
    for line in found.noise:
        relative_sigma = 100 * max(sigma / slope for sigma, slope in zip(line.slope_sigma, line.slope, strict=True))
        electrons, read = _join_numbers(line.electrons_at_white, ".0f"), _join_numbers(line.read_noise_electrons, ".1f")
        if line.read_noise_sigma:
            read += f" ± {max(line.read_noise_sigma):.1f}"
        source = "a bracket" if line.source == "bracket" else line.source
        text = f"{electrons} e⁻ at white ± {relative_sigma:.1f} %, read noise {read} e⁻, from {source}"
        rows.append(f"noise      ISO {line.iso:g}: {text}")
    if (levels := found.levels) is not None:
        black, stated = _join_numbers(levels.black, ".2f"), _join_numbers(levels.black_stated, "g")
        white = "no frame saturates" if levels.white is None else f"white {levels.white:g}"
        rows.append(f"levels     black {black} (stated {stated}), {white} (stated {levels.white_stated:g})")
    if (curve := found.linearity) is not None:
        power = f"power {curve.power:.4f} ± {curve.power_sigma:.4f}"
        span = f"from {100 * curve.darkest:.0f} to {100 * curve.brightest:.0f} % of white"
        rows.append(f"linearity  {power}, within {100 * curve.greatest_deviation:.2f} % {span}")
    if (light := found.falloff) is not None:
        rows.append(f"falloff    corners {_join_numbers(light.corner, '.3f')} of the middle")
    if (lens := found.geometry) is not None:
        rows.append(
            f"lens       {lens.focal_px:.1f} ± {lens.focal_sigma_px:.1f} px, k1 {lens.k1:+.4f} ± {lens.k1_sigma:.4f}, "
            f"k2 {lens.k2:+.4f} ± {lens.k2_sigma:.4f}; {lens.photographs} boards ({lens.board}), corners within "
            f"{lens.residual_px:.2f} px (without distortion {lens.pinhole_residual_px:.2f} px)"
        )
    if (ring := found.polarizer) is not None:
        sense = "counter-clockwise" if ring.sense > 0 else "clockwise"
        sense = f"counts {sense}" if ring.sense_known else "sense unknown: photograph light of a second axis"
        relative_sigma = max(sigma / ratio for sigma, ratio in zip(ring.extinction_sigma, ring.extinction, strict=True))
        extinction = f"extinction {_join_numbers(ring.extinction, '.0f')} ± {100 * relative_sigma:.0f} %"
        rows.append(f"polarizer  zero {ring.zero_deg:+.2f}° ± {ring.zero_sigma_deg:.2f}°, {sense}, {extinction}")
    if (flash := found.flash) is not None:
        drift = f"drift {100 * flash.drift_per_pop:+.3f} % ± {100 * flash.drift_sigma:.3f} % a pop"
        spread = f"{100 * flash.spread:.2f} % ± {100 * flash.spread_sigma:.2f} % from pop to pop"
        rows.append(f"flash      {spread}, {drift}, {flash.pops} pops")
    return rows


def _join_numbers(values: tuple[float, ...], form: str) -> str:
    return ", ".join(format(value, form) for value in values)
