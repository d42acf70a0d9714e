"""Flat and sharp-edged objects: their outline is no occluding contour, so its polarization shows no tilt.

At an occluding contour the surface turns away from the camera, so its polarization grows towards the outline. At the
edge of a plate or a box it does not. The facing plane of a coin or a painting is hardly polarized at all, a tilted
plane is polarized alike everywhere. Measured on thirty flat and sharp-edged objects and five rounded ones
(tests/benchmarks/bench_flat.py).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from polcap.image_values import Bools, Floats
from polcap.optics import outline
from polcap.optics.frames import total
from polcap.optics.resize import block_means, block_step
from polcap.quality.gate_values import MOST_DEG, Evidence, Gate
from polcap.results import ResultsUntilInfer
from polcap.stage_values import StokesImage, SurfaceMaps

_MOST_PIXELS = 1e4  # of the object; a larger picture is averaged down
_RIM, _INNER = 0.08, (0.2, 0.4)  # bands along the outline, by depth over the object's radius
_MIXED_PX, _LEAST_RIM_PX = 2.0, 4.0  # from the outline: mixed with the backdrop; least end of the outer band
_FEW = 5  # least px of a sector's band
_GROWTH, _LEAST_DOLP = 1.5, 0.04  # of the DoLP in a sector with an occluding contour
_ROUNDED = 0.2  # share of such sectors: plates, coins and sheets up to .17, unless tilted; bodies from .25
_ONE_PLANE = 0.5  # common part of the polarization: rounded objects up to .46; beyond, orders look alike
_LIT = 0.85  # light of an outline that is not dimmed: wax too is hardly polarized, but dimmed to .8 and less
_WALL_DOLP = 0.1  # of a part of the outline: where it does not grow outwards, a wall of a can or a box; wax has less
_FACING_DOLP = 0.045  # most of the outline of a plane that faces the camera
_ALIGNED = 0.84  # length of the mean normal: boxes up to .83, except one whose normals are wrong; bodies up to .77
_ONE_NORMAL = 0.92  # of the mean normal: beyond, the outline decides nothing, even if bars polarize it
_KNOWN_DEG = 7.0  # expected error of normals: a box that shows one face has 6, a tilted coin 9, plates 14 to 16
# least length of the mean normal, and least expected error, of a bent sheet: crumpled sheets have .80 to .88 and 18 to
# 29° (true errors up to 46°), rounded bodies up to .77 (docs/benchmarks/gates.md)
_SHEET_ALIGNED, _SHEET_DEG = 0.78, 15.0
_TILTED = np.cos(np.radians(20.0))  # of the mean normal: more tilt shows little more


@dataclass(frozen=True)
class Flatness:
    """Flatness of an object, and share of its outline that is an occluding contour."""

    contour: float  # share of the outline's sectors in which the polarization grows towards the outline
    common: float  # 0…1, length of the mean polarization over its mean length: 1 for one plane, 0 for a sphere
    rim_dolp: float  # 90th percentile along the outline
    rim_light: float  # median along the outline over that of the object
    aligned: float  # 0…1, length of the mean normal
    facing: float  # cosine of the mean normal's tilt
    expected_deg: float  # median expected error of the normals

    @property
    def sharp_edged(self) -> bool:
        """Whether the outline is the edge of faces, at least in most parts."""
        unlike_wax = self.rim_light > _LIT or self.rim_dolp > _WALL_DOLP
        one_plane = self.common > _ONE_PLANE or (self.aligned > _ONE_NORMAL and self.rim_light > _LIT)
        return (self.contour < _ROUNDED and unlike_wax) or one_plane

    @property
    def one_normal(self) -> bool:
        """Whether the normals are about those of one plane: a rounded object of wax has up to .81."""
        return self.aligned > _ALIGNED

    @property
    def unpolarized(self) -> bool:
        """Whether most of the outline is hardly polarized, as that of a plane that faces the camera."""
        return self.rim_dolp < _FACING_DOLP

    @property
    def flat(self) -> bool:
        """Whether the object is one plane, except for its relief."""
        one_plane = self.unpolarized or self.common > _ONE_PLANE or self.aligned > _ONE_NORMAL
        return self.sharp_edged and self.one_normal and one_plane

    @property
    def sheet(self) -> bool:
        """Whether the object is a bent sheet or the like: no occluding contour, and normals that are not known."""
        edged = self.sharp_edged and self.contour < _ROUNDED and not self.unpolarized
        return edged and not self.flat and self.aligned > _SHEET_ALIGNED and self.expected_deg > _SHEET_DEG

    def decides(self, ratio: float) -> bool:
        """Whether another order of the shots, with expected errors of `ratio` times these, leaves known normals."""
        return not self.sheet or ratio * self.expected_deg < _SHEET_DEG


def judge(found: Evidence[ResultsUntilInfer]) -> Iterator[Gate]:
    """Gates "flat" and "contour": whether the object is one plane, and whether its outline is an occluding contour."""
    shape = measure(found.results.stokes, found.results.maps)
    if shape is None:
        yield Gate("flat", "not measured", None, _ONE_PLANE, "The object is too small")
        return
    if shape.flat and shape.expected_deg > _KNOWN_DEG:
        message = (
            "The object is flat: a surface that faces camera and flash is hardly polarized, so one picture shows "
            "neither its relief nor its gloss"
        )
        if found.results.radiance.crossed is not None:
            message += "; the cross-polarized shot shows its color without highlights"
        remedy = "Photograph it from five to nine sides for `polcap material`, which measures both"
        if shape.facing > _TILTED:
            remedy += "; a single picture shows more of it where it is tilted by 30°"
        yield Gate("flat", "warn", round(shape.common, 3), _ONE_PLANE, message, remedy)
    elif shape.sheet:
        message = (
            "The outline is no occluding contour, as of a bent sheet, a relief or a thin object: one picture does not "
            f"show which way its parts lean (expected error {shape.expected_deg:.0f}°)"
        )
        remedy = "Photograph it from several sides for `polcap fuse`"
        yield Gate("flat", "warn", round(shape.expected_deg, 1), _SHEET_DEG, message, remedy, unit="°")
    else:
        message = "The object is flat, and its polarization shows its tilt" if shape.flat else "The object is not flat"
        yield Gate("flat", "pass", round(shape.common, 3), _ONE_PLANE, message)
    value = round(shape.contour, 3)
    if shape.sharp_edged:
        message = (
            "The outline is the edge of flat faces: its polarization shows neither the angles' order nor the light"
        )
        yield Gate("contour", "not measured", value, _ROUNDED, message)
    else:
        message = f"Polarization grows towards {100 * value:.0f} % of the outline, as where a surface turns away"
        yield Gate("contour", "pass", value, _ROUNDED, message)


def measure(image: StokesImage, maps: SurfaceMaps) -> Flatness | None:
    """Measure the flatness of an object; None if the object is too small."""
    step = block_step(image.mask.sum(), _MOST_PIXELS)
    inside = block_means(image.mask.astype(np.float32), step) > 0.99
    s0, s1, s2 = (block_means(part, step) for part in total(image.stokes))
    polarized = (s1 + 1j * s2) / np.maximum(s0, 1e-9)
    dolp = np.minimum(np.abs(polarized), outline.DOLP_CAP)
    depth, radius = outline.depth(inside), outline.disc_radius(inside)
    body = inside & (depth > _MIXED_PX)
    rim = body & (depth <= max(_RIM * radius, _LEAST_RIM_PX))
    inner = (depth > _INNER[0] * radius) & (depth < _INNER[1] * radius)
    of_rim, of_inner = (_by_sector(dolp, band) for band in (rim, inner))
    both = np.isfinite(of_rim) & np.isfinite(of_inner)
    if not both.any():
        return None
    mean = (dolp * np.exp(1j * np.angle(polarized)))[body].mean()
    normal = maps.normal[maps.mask].mean(axis=0) if maps.mask.any() else np.array([0.0, 0.0, 1e-9])
    aligned = float(np.linalg.norm(normal))
    return Flatness(
        contour=float((of_rim > np.maximum(_GROWTH * of_inner, _LEAST_DOLP))[both].mean()),
        common=float(np.abs(mean) / max(float(dolp[body].mean()), 1e-9)),
        rim_dolp=float(np.quantile(dolp[rim], 0.9)),
        rim_light=float(np.median(s0[rim]) / max(float(np.median(s0[body])), 1e-9)),
        aligned=aligned,
        facing=float(normal[2] / aligned),
        expected_deg=float(np.median(maps.confidence[maps.mask])) if maps.mask.any() else MOST_DEG,
    )


def _by_sector(value: Floats, band: Bools) -> Floats:
    """Medians (24,) of a map (H, W) over the sectors of a band (H, W); NaN for sectors with few pixels."""
    sector, inside = outline.sectors(band), value[band]
    parts = (inside[sector == k] for k in range(outline.SECTORS))
    return np.array([np.median(part) if len(part) >= _FEW else np.nan for part in parts])
