"""Plots of the report as SVG drawings, in the colors of the page's theme."""

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.report import keys
from polcap.report.labels import number

CHANNELS = ("#e0434c", "#2f9e4d", "#3f78e0")  # red, green, blue on light and dark


def svg(width: float, height: float, parts: Sequence[str], title: str) -> str:
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}" role="img" '
        f'aria-label="{escape(title)}">{"".join(parts)}</svg>'
    )


def hexed(color: NDArray[np.uint8]) -> str:
    """8-bit sRGB as a CSS color."""
    return "#" + bytes(color.astype(np.uint8)).hex()


def _text(x: float, y: float, words: str, anchor: str = "start", style: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{style}>{escape(words)}</text>'


def chart(reference: NDArray[np.uint8], measured: NDArray[np.uint8], delta_e: Floats, names: Sequence[str]) -> str:
    """24 patches: the maker's color outside, the photographed color inside, ΔE below."""
    cell = 76
    parts: list[str] = []
    for index in range(24):
        row, column = divmod(index, 6)
        x, y = column * cell + 4, row * (cell + 14) + 4
        outer, inner = hexed(reference[index]), hexed(measured[index])
        error = float(delta_e[index])
        label = f"{names[index]}: " + ("left out" if np.isnan(error) else f"ΔE {error:.2f}")
        parts.append(
            f'<g><title>{escape(label)}</title><rect x="{x}" y="{y}" width="{cell - 8}" height="{cell - 8}" rx="4" '
            f'fill="{outer}"/><rect x="{x + 16}" y="{y + 16}" width="{cell - 40}" height="{cell - 40}" fill="{inner}"/>'
            "</g>" + _text(x + cell / 2 - 4, y + cell + 4, "left out" if np.isnan(error) else f"{error:.1f}", "middle")
        )
    return svg(6 * cell, 4 * (cell + 14) + 6, parts, "Chart: measured color inside, reference outside, ΔE2000 below")


def exposures(measured: list[list[float]], stated: list[list[float | None]], angles: Sequence[float]) -> str:
    """Exposure of each frame in stops: measured in the pixels (dot) and stated by the camera (ring)."""
    known: list[float] = [value for rows in (measured, stated) for row in rows for value in row if value]
    low, high = np.floor(np.log2(min(known)) - 0.3), np.ceil(np.log2(max(known)) + 0.3)
    left, width, step = 56, 440, 34
    parts, bottom = [], step * len(measured) + 8

    def at(value: float) -> float:
        return float(left + (np.log2(value) - low) / (high - low) * (width - left - 16))

    for stop in range(int(low), int(high) + 1):
        x = at(2.0**stop)
        parts.append(f'<line class="faint" x1="{x:.1f}" x2="{x:.1f}" y1="6" y2="{bottom}"/>')
        parts.append(_text(x, bottom + 16, "0" if stop == 0 else f"{stop:+d}", "middle", ' class="soft"'))
    for row, angle in enumerate(angles):
        y = 22 + step * row
        parts.append(_text(0, y + 4, f"{angle:g}°"))
        for frame, value in enumerate(measured[row]):
            claim = stated[row][frame] if row < len(stated) and frame < len(stated[row]) else None
            if claim:
                parts.append(f'<circle cx="{at(claim):.1f}" cy="{y}" r="9" fill="none" stroke="currentColor"/>')
            if value:
                title = f"{angle:g}°, frame {frame + 1}: {number(value)} ×" + (
                    f", stated {number(claim)}" if claim else ""
                )
                parts.append(
                    f'<circle cx="{at(value):.1f}" cy="{y}" r="5" fill="{CHANNELS[2]}"><title>{title}</title></circle>'
                )
    parts.append(_text(width - 8, bottom + 32, "stops", "end", ' class="soft"'))
    return svg(width, bottom + 38, parts, "Exposures: measured (dots) and stated by the camera (rings)")


def gains(gain: Floats, sigma: Floats, anchor: Floats, angles: Sequence[float]) -> str:
    """Light of each shot relative to the first, per channel with 1σ; crosses: from pixels that face the camera."""
    far = np.concatenate([(gain - 1).ravel(), np.nan_to_num(anchor - 1).ravel()])
    span = max(0.005, 1.15 * float(np.abs(far).max()))
    left, width, step, parts = 56, 440, 46, []
    bottom = step * len(gain) + 6

    def at(value: float) -> float:
        return float(left + (0.5 + 0.5 * np.clip((value - 1) / span, -1, 1)) * (width - left - 24))

    for share in (-1, -0.5, 0, 0.5, 1):
        x = at(1 + share * span)
        parts.append(f'<line class="faint" x1="{x:.1f}" x2="{x:.1f}" y1="4" y2="{bottom}"/>')
        words = "equal" if share == 0 else f"{100 * share * span:+.1f} %"
        parts.append(_text(x, bottom + 16, words, "middle", ' class="soft"'))
    for row, angle in enumerate(angles):
        parts.append(_text(0, 26 + step * row, f"{angle:g}°"))
        for channel, paint in enumerate(CHANNELS):
            y, value, error = 12 + step * row + 11 * channel, float(gain[row, channel]), float(sigma[row, channel])
            x = at(value)
            parts.append(
                f'<line x1="{at(value - error):.1f}" x2="{at(value + error):.1f}" y1="{y}" y2="{y}" stroke="{paint}" '
                f'stroke-width="2"/><circle cx="{x:.1f}" cy="{y}" r="4" fill="{paint}"><title>{angle:g}°, '
                f"{('red', 'green', 'blue')[channel]}: {value:.4f} ± {error:.4f}</title></circle>"
            )
            if np.isfinite(anchor[row, channel]):
                cross = at(float(anchor[row, channel]))
                parts.append(f'<path d="M{cross - 4:.1f} {y - 4}l8 8m0 -8l-8 8" stroke="{paint}" stroke-width="1.5"/>')
    return svg(width, bottom + 24, parts, "Light of each shot relative to the first")


def shifts(transform: Floats, residual_px: Floats, angles: Sequence[float]) -> str:
    """Shift of each shot relative to the first: a line per shot, its 1σ as a circle."""
    moved = transform[:, :2, 2]
    span = max(0.5, 1.2 * float(np.abs(moved).max() + residual_px.max()))
    side, parts = 240, []
    half = side / 2

    def at(value: float) -> float:
        return float(half + value / span * (half - 12))

    for share in (-1, 0, 1):
        line = at(share * span)
        parts.append(f'<line class="faint" x1="{line}" x2="{line}" y1="12" y2="{side - 12}"/>')
        parts.append(f'<line class="faint" y1="{line}" y2="{line}" x1="12" x2="{side - 12}"/>')
    for (x, y), sigma, angle in zip(moved, residual_px, angles):
        right, down = at(float(x)), at(float(y))
        radius = max(2.5, float(sigma) / span * (half - 12))
        parts.append(
            f'<line x1="{half}" y1="{half}" x2="{right:.1f}" y2="{down:.1f}" stroke="currentColor" opacity=".5"/>'
            f'<circle cx="{right:.1f}" cy="{down:.1f}" r="{radius:.1f}" fill="{CHANNELS[2]}">'
            f"<title>{angle:g}°: {x:+.2f}, {y:+.2f} px ± {sigma:.3f}</title></circle>"
        )
        parts.append(_text(right + 7, down - 6, f"{angle:g}°"))
    parts.append(_text(side - 12, half - 6, f"{number(span, 2)} px", "end", ' class="soft"'))
    return svg(side, side, parts, "Shift of each shot")


def timings(seconds: dict[str, float]) -> str:
    """Computing time: one bar per stage."""
    if not seconds:
        return ""
    most, step, left, width, parts = max(max(seconds.values()), 1e-3), 22, 110, 440, []
    for row, (name, spent) in enumerate(seconds.items()):
        y, length = 4 + step * row, spent / most * (width - left - 70)
        parts.append(_text(0, y + 13, name))
        parts.append(
            f'<rect x="{left}" y="{y + 2}" width="{max(length, 1):.1f}" height="14" rx="2" fill="{CHANNELS[2]}"/>'
        )
        parts.append(_text(left + length + 8, y + 13, f"{spent:.2f} s"))
    return svg(width, step * len(seconds) + 8, parts, "Seconds of each stage")


def wheel() -> str:
    """Color wheel of the angle of linear polarization; 180° run once through all hues."""
    paint, middle, parts = keys.colors("wheel"), 60, []
    for step in range(72):
        turn = np.radians([5 * step, 5 * step + 5.3])
        x, y = middle + 40 * np.cos(turn), middle - 40 * np.sin(turn)
        color = hexed(paint[round((5 * step % 180) / 180 * keys.LEVELS) % keys.LEVELS])
        parts.append(f'<path d="M{middle} {middle}L{x[0]:.1f} {y[0]:.1f}L{x[1]:.1f} {y[1]:.1f}Z" fill="{color}"/>')
    for angle in (0, 45, 90, 135):
        x_, y_ = middle + 51 * np.cos(np.radians(angle)), middle - 51 * np.sin(np.radians(angle))
        parts.append(_text(float(x_), float(y_) + 4, f"{angle}°", "middle", ' style="font-size:10px"'))
    return svg(2 * middle, 2 * middle, parts, "Wheel of the angle of linear polarization")


def ball() -> NDArray[np.uint8]:
    """Ball colored by its normals, (96, 96, 4), on a transparent background."""
    side = 96
    y, x = np.mgrid[1 : -1 : side * 1j, -1 : 1 : side * 1j]
    z2 = 1 - x * x - y * y
    normal = np.stack([x, y, np.sqrt(np.maximum(z2, 0))], axis=-1)
    rgb = np.rint(255 * (normal / 2 + 0.5)).astype(np.uint8)
    return np.concatenate([rgb, np.where(z2 > 0, 255, 0).astype(np.uint8)[..., None]], axis=-1)
