"""Gates of place: what moved, what is out of focus, what is out of the frame."""

import numpy as np

from polcap.config import Config, Gates
from polcap.formats import shipped_data
from polcap.images import Floats, Mesh, SurfaceMaps
from polcap.optics.sharpness import TILE
from polcap.quality.gate import Evidence, Gate, State, Unit, at_most, blamed
from polcap.stages.align import object_motion
from polcap.stages.whitebalance import chart_in_mask


def alignment(found: Evidence, config: Config) -> Gate:
    """How far camera or object moved from shot to shot, in px of the picture that is processed, and how surely."""
    measured, names = found.alignment, found.names
    height, width = found.radiance.value.shape[1:3]
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], float).T
    at = measured.transform @ corners  # (K, 3, 4)
    shift = np.abs(at[:, :2] / at[:, 2:] - corners[:2]).max((1, 2)) * found.grid_px
    limit = config.align.max_shift_px
    lost = (measured.correlation < config.align.min_correlation) | ~np.isfinite(shift)
    doubt = measured.residual_px * found.grid_px
    unsure = doubt > config.gates.max_align_residual_px * max(found.grid_px, 1)
    bad = lost | (shift > limit) | unsure
    worst = int(np.argmax(np.where(bad, 1e9, 0) + np.nan_to_num(shift)))
    says = f"{names[worst]} moved by {shift[worst]:.1f} px, sure to {doubt[worst]:.2f}"
    figure = float(shift[worst])
    unit: Unit = "px"
    if lost[worst]:
        says = f"{names[worst]} shows another scene, or moved too far to be followed"
        if shift[worst] <= limit:
            figure, limit, unit = float(measured.correlation[worst]), config.align.min_correlation, ""
    elif unsure[worst] and shift[worst] <= limit:
        says = f"{names[worst]} moved by {shift[worst]:.1f} px, sure to {doubt[worst]:.2f} only: too little texture"
        figure, limit = float(doubt[worst]), config.gates.max_align_residual_px * max(found.grid_px, 1)
    value = round(figure, 3) if np.isfinite(figure) else None
    if not bad.any():
        pushed = _pushed(found, config)
        return pushed or Gate("alignment", "pass", value, limit, says, unit="px")
    remedy = "lock the camera, do not touch the object, and take that shot again"
    return Gate("alignment", "fail", value, limit, says, remedy, 10.0, blamed(names, bad), unit)


def _pushed(found: Evidence, config: Config) -> Gate | None:
    """An object that moved while what is around it stood still."""
    displacement = _displacement(found) * found.grid_px
    limit = config.gates.max_object_shift_px
    bad = np.nan_to_num(displacement, posinf=np.inf) > limit
    if not bad.any():
        return None
    worst = int(np.nanargmax(displacement))
    says = f"the object moved by {displacement[worst]:.1f} px against what is around it in {found.names[worst]}"
    figure: float | None = round(float(displacement[worst]), 3)
    if np.isinf(displacement[worst]):
        figure, says = None, f"{found.names[worst]} shows another object before the same surroundings"
    remedy = "let it stand firm, do not touch it between shots, and take that shot again"
    cost = 45.0 if figure is None else 5.0
    return Gate("alignment", "fail", figure, limit, says, remedy, cost, blamed(found.names, bad), "px")


def _displacement(found: Evidence) -> Floats:
    return object_motion.measure(found.radiance, found.alignment, found.object_)


def mask(found: Evidence, limits: Gates) -> Gate:
    """Fails where a chart is in it or the network doubts it; warns from half of that on, and of shapes none has."""
    object_, limit, doubt = found.object_, limits.max_mask_doubt, found.object_.doubt
    faults: list[tuple[str, float, float]] = []  # in words, its figure, its limit
    charted = 0.0
    if found.color.place is None:
        charted = _charted(found)
    if charted:
        faults.append(
            (f"{charted:.0%} of it looks like a colour chart that was not found, and is no object", charted, 0)
        )
    doubted = doubt is not None and doubt > limit
    if doubt is not None and doubt > limit / 2:
        faults.append(("which pixels are the object is not clear", doubt, limit if doubted else limit / 2))
    for says, figure, most in (
        ("the object leaves the picture along {:.0%} of its border, where its outline tells nothing",
         object_.border, limits.max_mask_border),
        ("{:.0%} of it stands apart", object_.islands, limits.max_mask_islands),
        ("it has holes of {:.0%} of its area", object_.holes, limits.max_mask_holes),
    ):  # fmt: skip
        if figure > most:
            faults.append((says.format(figure), figure, most))
    if not faults and doubt is not None:
        return Gate("mask", "pass", doubt, limit, f"its network expects {100 * doubt:.1f} % of it to be wrong")
    if not faults:
        known = object_.source == "user"
        says = "as given" if known else "no network looked for it"
        return Gate("mask", "pass" if known else "not measured", None, limit, says)
    state: State = "fail" if charted or doubted else "warn"
    remedy = "look at it, and where it is wrong give --mask PNG; let backdrop show all around the object"
    cost = 10 * object_.border if state == "warn" else 5.0
    _, value, most = faults[0]
    return Gate("mask", state, round(value, 5), most, "; ".join(fault[0] for fault in faults), remedy, cost)


def _charted(found: Evidence) -> float:
    return float(chart_in_mask.share(found.radiance, found.object_.mask, shipped_data.colorchecker()))


def mesh(of: Mesh, limits: Gates) -> Gate:
    """Fails where the surface is in shreds: many pieces, cuts longer than its outline, or a jagged rim.

    A cut says that the normals fit better with the surface apart there: where a part hides another, and where they err.
    """
    faults: list[tuple[str, float, float, Unit]] = []  # in words, its figure, its limit
    remedies = []
    pieces, cuts, rim = limits.max_mesh_pieces, limits.max_mesh_cuts, limits.max_mesh_raggedness
    if of.pieces > pieces:
        faults.append((f"{of.pieces} pieces, more than {pieces}", of.pieces, pieces, ""))
    if of.cuts > cuts:
        says = f"cuts of {of.cut_px:.0f} px, {of.cuts:.0%} of the outline's length, more than {cuts:.0%}"
        faults.append((says, of.cuts, cuts, "%"))
    if faults:
        remedies.append("the normals fit no surface, see their error; --set surface.stiffness=0 closes all cuts")
    if of.raggedness > rim:
        says = f"a rim {of.raggedness:.0%} longer than its curve, more than {rim:.0%}"
        faults.append((says, of.raggedness, rim, "%"))
        remedies.append("where the mask's outline is jagged give --mask PNG")
    if faults:
        _, value, limit, unit = faults[0]
        said = "; ".join(fault[0] for fault in faults)
        return Gate("mesh", "fail", round(value, 4), limit, said, "; ".join(remedies), unit=unit)
    says = f"{of.pieces} {'piece' if of.pieces == 1 else 'pieces'}, "
    says += (
        f"cut along {of.cut_px:.0f} px where the normals fit better apart: behind a part, or at a slit where they err"
        if of.cut_px
        else "no cut inside the outline"
    )
    return Gate("mesh", "pass", round(of.cuts, 4), cuts, says)


def sharpness(found: Evidence, limits: Gates) -> Gate:
    """Every frame against the frames of the same exposure in the other shots."""
    blur, limit = found.blur_px, limits.max_blur_px
    moved = float(np.abs(found.alignment.transform[:, :2, 2]).max()) * found.grid_px
    if np.isnan(blur).all():
        return Gate("sharpness", "not measured", None, limit, "too little bright detail", unit="px")
    if not moved <= TILE / 2:  # tiles would compare unlike detail
        return Gate("sharpness", "not measured", None, limit, "the shots show different places", unit="px")
    k, e = (int(i) for i in np.unravel_index(int(np.nanargmax(blur)), blur.shape))
    says = f"{found.names[k]} frame {e + 1} is blurred by {blur[k, e]:.1f} px beyond the sharpest"
    bad = blamed(found.names, np.nanmax(np.nan_to_num(blur), axis=1) > limit)
    remedy = "focus by hand and tape the ring, use a remote release, then take it again"
    return at_most("sharpness", float(blur[k, e]), limit, says, remedy, bad, 3, "px")


def focal_length(found: Evidence) -> Gate:
    """Whether it is known; where not, what it costs: normals stand on view rays, which lean as it says."""
    least, most = found.focal_doubt
    if not most - least:
        return Gate("focal length", "pass", "known", "known", "known", unit="")
    cost = _lean(found.maps, least, most)
    times = np.exp(max(most, -least))
    says = f"the focal length is assumed, perhaps {times:.1f} times off; a wrong one bends shape and depth"
    remedy = "state focal_length_mm and sensor_width_mm in capture.toml"
    return Gate("focal length", "warn", "assumed", "known", says, remedy, round(cost, 1), unit="")


def _lean(maps: SurfaceMaps, least: float, most: float) -> float:
    """Degrees by which the view rays of the object lean otherwise, in the median pixel."""
    y, x = np.nonzero(maps.mask)
    off = np.hypot(x - maps.view.center[0], y - maps.view.center[1]) / maps.view.focal
    lean, more, less = (np.arctan(off * factor) for factor in (1.0, np.exp(-least), np.exp(-most)))
    return float(np.degrees(np.median(np.maximum(more - lean, lean - less)))) if len(off) else 0.0
