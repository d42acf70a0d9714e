"""Compares the masks of the views: removes parts that one view alone shows, and finds masks that contradict the others.

The points that lie inside the masks of all views form the visual hull; every pixel of the object shows one of them.
Where the hull leaves a part of one mask uncovered, this mask holds the board's edge, a shadow or a reflection, and
the part is removed. Where it leaves parts of several masks uncovered that it covers without one view, this view's mask
lacks a part of the object. If the object slid, its mask shows one side too far out, and lacks the other side.

A slit in one mask, such as a narrow shadow, cuts through the whole hull, and so does a hole. So slits and small holes
are closed first, where the hull of the other masks is solid.

References
----------
Laurentini, The visual hull concept for silhouette-based image understanding, IEEE TPAMI 1994.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from polcap.errors import CaptureError
from polcap.formats.capture.folder_names import set_of_view
from polcap.fusion.poses import LEAST_VIEWS
from polcap.fusion.silhouettes import Silhouette, grid_around, halve
from polcap.image_values import Bools, Floats
from polcap.optics.outline import disc_radius
from polcap.stages import stage
from polcap.stages.mask import likely_regions
from polcap.stages.mask.likely_regions import fill_holes

COMPARED = "work/compared_masks"  # folder in the result of a session: the masks, as they were compared
_SLIT = 0.05  # of the object's diameter in a view; wider gaps in a mask are gaps between the object's parts
_HOLE = 0.01  # of a mask's area; larger holes may be holes of the object
_MOST_UNCOVERED = 0.01  # of a mask's area; masks whose outlines err by one cell of the grid leave 0.000
# If the object slid in one view, the hull of the others covers a little more of several masks without this view. From
# this sum of the gained shares on, a view counts as slid. The greatest gain is left out: its mask may hold some board.
_SLIDE = 0.002
_MOST_LEFT_OUT = 1 / 3  # of the views; where more contradict, nobody knows which are right
_MOST_TRIMMED = 1 / 2  # of the views: most that are left out or hold more than the object


@dataclass(frozen=True)
class AgreedMasks:
    """Masks of the views that agree, without parts that the others do not confirm."""

    names: tuple[str, ...]  # of these views
    masks: tuple[Bools, ...]  # (H, W) on their merged pictures
    left_out: Mapping[str, str]  # reason, by view whose mask contradicts the others


@stage(version=1)
def agree(views: tuple[Silhouette, ...]) -> AgreedMasks:
    """Compare the masks of each set of views: views with the object lying on the same side.

    The largest connected part of each agreeing mask stays; remains of the board are smaller.

    Raises CaptureError: as `compare_set`.
    """
    used, left_out = list[Silhouette](), dict[str, str]()
    for set_name in dict.fromkeys(set_of_view(view.name) for view in views):
        agreeing, reasons = compare_set([view for view in views if set_of_view(view.name) == set_name])
        used, left_out = used + agreeing, left_out | reasons
    masks = tuple(likely_regions.nth_part(view.mask, 1) for view in used)
    return AgreedMasks(tuple(view.name for view in used), masks, left_out)


def compare_set(views: Sequence[Silhouette]) -> tuple[list[Silhouette], dict[str, str]]:
    """Masks that agree, without parts that no other view confirms; and reasons for views left out, by name.

    Raises CaptureError: more than a third of the views contradict the others, fewer than three are left, or the masks
    have too little in common.
    """
    points, step = grid_around(views)
    used = _close_gaps(views, points, step)
    left_out: dict[str, str] = {}
    inside = np.stack([view.shows(points, step) for view in used])  # (N, P)
    while True:
        shares = _uncovered(used, points[inside.all(axis=0)], step)
        worst, share = _find_contradicting(used, inside, points, step, shares)
        if share <= _MOST_UNCOVERED:
            break
        view = used.pop(worst)
        inside = np.delete(inside, worst, axis=0)
        left_out[view.name] = (
            f"its mask and those of the other views differ by {100 * share:.1f} % of their area, the limit is "
            f"{100 * _MOST_UNCOVERED:g} %: the mask is wrong, or the object moved on the board; compare the pictures "
            f"in {COMPARED}, and shoot the view again"
        )
        if len(left_out) > _MOST_LEFT_OUT * len(views) or len(used) < LEAST_VIEWS:
            raise _contradiction(list(left_out), len(views))
    larger = [view.name for view, share in zip(used, shares, strict=True) if share > _MOST_UNCOVERED]
    if len(left_out) + len(larger) > _MOST_TRIMMED * len(views):
        raise _contradiction([*left_out, *larger], len(views))
    return _trim(used, points[inside.all(axis=0)], step), left_out


def _close_gaps(views: Sequence[Silhouette], points: Floats, step: float) -> list[Silhouette]:
    """The views with slits and small holes of their masks closed where all other masks have a point in common."""
    inside = np.stack([view.shows(points, step) for view in views])
    votes = inside.sum(axis=0)
    out = []
    for view, own in zip(views, inside, strict=True):
        reach = max(round(_SLIT * disc_radius(view.mask)), 1)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        framed = np.pad(view.mask.astype(np.uint8), reach)
        closed = fill_holes(cv2.morphologyEx(framed, cv2.MORPH_CLOSE, disc)[reach:-reach, reach:-reach], _HOLE)
        hull_of_others = points[votes - own == len(views) - 1]  # inside all other masks
        out.append(replace(view, mask=view.mask | closed & view.covered(hull_of_others, step)))
    return out


def _contradiction(names: Sequence[str], count: int) -> CaptureError:
    """Error for too many views whose masks contradict the others, of `count`."""
    return CaptureError(
        f"the masks of {len(names)} of {count} views contradict the others ({', '.join(names)}): the object moved on "
        f"the board between the views, or masks are wrong; compare the pictures in {COMPARED}, fix the object to the "
        "board, and shoot again"
    )


def _uncovered(views: Sequence[Silhouette], hull: Floats, step: float) -> Floats:
    """Share (N,) of each view's mask that the hull's points (P, 3) do not cover, on a grid as coarse as the hull's."""
    shares = []
    for view in views:
        mask, covered = view.coarse(hull, step)
        shares.append(float((mask & ~covered).sum() / max(mask.sum(), 1)))
    return np.array(shares)


def _find_contradicting(
    views: Sequence[Silhouette], inside: Bools, points: Floats, step: float, shares: Floats
) -> tuple[int, float]:
    """The view without which the others agree best, and the share of a mask's area by which it contradicts; 0: none."""
    contradiction, improvement = np.zeros(len(views)), np.zeros(len(views))
    if (shares > _MOST_UNCOVERED).any():
        for k in range(len(views)):
            others = [j for j in range(len(views)) if j != k]
            rest = _uncovered([views[j] for j in others], points[inside[others].all(axis=0)], step)
            newly_covered = np.sort(shares[others] - rest)[:-1]  # without the greatest
            missing_share = newly_covered[-1]  # the second greatest
            slide_share = shares[k] if newly_covered.sum() > _SLIDE else 0.0
            contradiction[k] = max(missing_share, slide_share)
            if contradiction[k] > _MOST_UNCOVERED:
                improvement[k] = slide_share + newly_covered.sum()
    worst = int(np.argmax(improvement))
    return worst, float(contradiction[worst])


def _trim(views: Sequence[Silhouette], hull: Floats, step: float) -> list[Silhouette]:
    """The views without the parts of their masks that the hull of all masks does not cover."""
    fine, half = halve(hull, step)
    fine = fine[fine[:, 1] > -half]  # the board is y = 0
    for view in views:
        fine = fine[view.shows(fine, half)]
    return [replace(view, mask=view.mask & view.covered(fine, half)) for view in views]
