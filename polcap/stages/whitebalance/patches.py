"""Samples the colors of a chart's patches, excludes unreliable patches, and fits the color matrix.

A patch is used unless it is clipped, outside the picture, uneven (a shadow's edge or a finger is on it), or an outlier
of the color matrix that fits most patches (it is hidden, in shade, or glossy).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from polcap.chart_values import ChartReference
from polcap.errors import ChartError
from polcap.image_values import Bits, Bools, Floats, Quality
from polcap.optics.projection import pixels_inside
from polcap.stages.whitebalance import chart, color_matrix
from polcap.stages.whitebalance.chart import Placement

WHITE = 18  # index of the white patch, the first of six greys
_LEAST = 12  # usable patches; the fit has 12 unknowns and three equations per patch
_CLIPPED = 0.02  # share of a patch's pixels that may be clipped
_UNEVEN, _UNEVEN_WHITE = 0.15, 0.01  # largest difference of a patch's quarter: a share of the patch plus one of white
_ODD, _LEAST_ODD = 6.0, 4.0  # an outlier has more than this many times the median ΔE, and at least this ΔE
_LEAST_SURROUNDINGS = 0.5  # share of the patches around a block that must agree with it
_MOST_COUNTED = 30.0  # an outlier's larger ΔE counts as this in `ChartFit.error`


class PatchUse(IntEnum):
    """Whether a chart patch was used for the color matrix, or the reason why not."""

    USED = 0
    CLIPPED = 1
    OUTSIDE = 2
    UNEVEN = 3
    ODD = 4


@dataclass(frozen=True)
class ChartFit:
    """Color matrix that was fitted to the patches of a chart in one shot."""

    fit: color_matrix.MatrixFit
    use: Bits  # (24,) PatchUse
    error: float  # mean ΔE2000 of the used patches and the outliers; decides whether this is a chart
    color: Floats  # (24, 3) S0 of the patches, camera channels


@dataclass(frozen=True)
class PatchSamples:
    """Colors of a chart's N patches in one shot, and whether each can be used."""

    color: Floats  # (N, 3) S0 of the patches, camera channels
    use: Bits  # (N,) PatchUse

    def select(self, which: Bools) -> "PatchSamples":
        """The patches that a mask (N,) selects."""
        return PatchSamples(self.color[which], self.use[which])

    def turned(self) -> "PatchSamples":
        """The patch colors of the same chart read upside down."""
        return PatchSamples(self.color[::-1], self.use[::-1])


def fit(samples: PatchSamples, reference: ChartReference) -> ChartFit:
    """Fit the color matrix (3, 3) from the patches of one shot to the known colors of the chart.

    Raises ChartError: fewer than 12 patches are usable.
    """
    seen, use = samples.color, samples.use
    usable = use == PatchUse.USED
    if usable.sum() < _LEAST:
        clipped, uneven = (int((use == reason).sum()) for reason in (PatchUse.CLIPPED, PatchUse.UNEVEN))
        why = (
            f"{24 - usable.sum()} of the chart's 24 patches cannot be used ({clipped} over-exposed, "
            f"{uneven} partly hidden or in shade), more than the {24 - _LEAST} allowed"
        )
        raise ChartError(f"{why}; add a shorter exposure to the bracket, or show the whole chart", why)
    error = color_matrix.trimmed_residuals(seen, reference.rec709, position(), usable)
    odd = usable & (error > max(_LEAST_ODD, _ODD * float(np.median(error[usable]))))
    if (usable & ~odd).sum() < _LEAST:  # no matrix fits most patches: use all
        odd[:] = False
    use = np.where(odd, PatchUse.ODD, use).astype(np.uint8)
    matrix_fit = color_matrix.fit_matrix(seen, reference.rec709, position(), usable & ~odd)
    delta_e = np.where(odd, np.minimum(error, _MOST_COUNTED), matrix_fit.delta_e)
    return ChartFit(matrix_fit, use, float(np.nanmean(delta_e)), seen)


def cross_validate(found: ChartFit, reference: ChartReference) -> Floats | None:
    """Color error ΔE2000 (24,) of each patch under the matrix fitted to all others; None for too few patches."""
    used = found.use == PatchUse.USED
    return color_matrix.cross_validate(found.color, reference.rec709, position(), used) if used.sum() > _LEAST else None


def residual(found: ChartFit, reference: ChartReference) -> float:
    """Mean ΔE2000 of the patches in use, after a fit to the colors of `reference`, an edition of the chart."""
    used = found.use == PatchUse.USED
    return float(np.nanmean(color_matrix.fit_matrix(found.color, reference.rec709, position(), used).delta_e))


def position() -> Floats:
    """Positions (24, 2) of the chart's patches relative to the white one, in patch pitches."""
    return np.asarray(chart.centers() - chart.centers()[WHITE])


def fit_with_surroundings(
    found: ChartFit, around: PatchSamples, reference: ChartReference
) -> tuple[color_matrix.MatrixFit, Floats]:
    """Fit the color matrix to all patches of a large chart: the 24 of its block `found` and the M `around` it.

    A surrounding patch is used if it agrees with the matrix of the block, because a chart may be partly hidden. If less
    than half of them agree, none is used. Residuals (24 + M,) of the fit are NaN for patches not used. Also returns the
    cross-validated ΔE2000 (24,) of the block's patches: each under the matrix of all others.
    """
    others = reference.surroundings
    assert others is not None
    at = others.center - chart.centers()[WHITE]
    error = color_matrix.residuals(found.fit, around.color, others.rec709, at)
    limit = max(_LEAST_ODD, _ODD * float(np.nanmedian(found.fit.delta_e)))
    agree = (around.use == PatchUse.USED) & (error < limit)
    agree &= agree.mean() >= _LEAST_SURROUNDINGS
    seen, known = np.vstack([found.color, around.color]), np.vstack([reference.rec709, others.rec709])
    arguments = (seen, known, np.vstack([position(), at]), np.concatenate([found.use == PatchUse.USED, agree]))
    return color_matrix.fit_matrix(*arguments), color_matrix.cross_validate(*arguments)[:24]


def sample(value: Floats, quality: Bits, place: Placement, share: float, at: Floats | None = None) -> PatchSamples:
    """Sample S0 of each chart patch in a shot (H, W, 3) with quality (H, W): twice the trimmed mean of its pixels.

    Only the inner part of a patch is sampled, a square with the share `share` of its side. `at` (M, 2) are the patches'
    centers, as in `Placement.quads`.
    """
    quads = place.quads(share, at)
    color, uneven = np.zeros((len(quads), 3)), np.zeros(len(quads))
    use = np.zeros(len(quads), np.uint8)
    for index, quad in enumerate(quads):
        x, y = pixels_inside(quad, value.shape).T
        if len(x) < 4:
            use[index] = PatchUse.OUTSIDE
            continue
        inside = value[y, x].astype(np.float64)
        pixels = np.sort(inside, axis=0)
        trim = len(pixels) // 10
        color[index] = 2 * pixels[trim : len(pixels) - trim].mean(axis=0)  # S0 of unpolarized light: twice a shot's
        uneven[index] = 2 * _between_quarters(inside, x - x.mean(), y - y.mean())
        if np.mean((quality[y, x] & Quality.CLIPPED) > 0) > _CLIPPED:
            use[index] = PatchUse.CLIPPED
    light = color.sum(axis=1)
    too_uneven = uneven > _UNEVEN * light + _UNEVEN_WHITE * light.max()
    return PatchSamples(color, np.where((use == PatchUse.USED) & too_uneven, PatchUse.UNEVEN, use).astype(np.uint8))


def left_out(use: Bits) -> str:
    """Text that lists the chart patches not used and why, from their use (24,); empty if all were used."""
    words = {
        PatchUse.CLIPPED: "over-exposed",
        PatchUse.OUTSIDE: "outside the picture",
        PatchUse.UNEVEN: "partly hidden or in shade",
        PatchUse.ODD: "hidden, in shade or shining",
    }
    numbers = {word: ", ".join(str(patch + 1) for patch in np.flatnonzero(use == one)) for one, word in words.items()}
    parts = [f"{patches} {word}" for word, patches in numbers.items() if patches]
    return f"left out, of patches 1 to 24: {'; '.join(parts)}" if parts else ""


def _between_quarters(pixels: Floats, x: Floats, y: Floats) -> float:
    """Unevenness of a patch: largest difference of light (sum of channels) between one quarter and the whole patch."""
    light = pixels.sum(axis=1)
    quarter = 2 * (x > 0) + (y > 0)
    means = [np.median(light[quarter == q]) for q in range(4) if (quarter == q).sum() >= 4]
    return float(np.abs(np.array(means) - np.median(light)).max()) if means else 0.0
