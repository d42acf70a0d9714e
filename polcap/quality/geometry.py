"""Gates of geometry: alignment, mask, mesh, outline, sharpness, focal length."""

from functools import partial
from pathlib import PurePath

import cv2
import msgspec
import numpy as np

from polcap.formats import shipped_data
from polcap.image_values import Bools, Floats, Quality
from polcap.mesh_values import Mesh
from polcap.optics import frames, outline
from polcap.optics.morphology import dilate, erode
from polcap.optics.projection import picture_corners, transform_points
from polcap.optics.registration import squared_gradient
from polcap.optics.resize import area_mean
from polcap.optics.sharpness import TILE
from polcap.quality import object_turn, rerendering, rim, shot_exposure
from polcap.quality.gate_values import MOST_DEG, Evidence, Gate, State, Unit, at_most, bad_shots, lit, reaches, worded
from polcap.quality.limits import GateLimits
from polcap.results import ResultsUntilAlign, ResultsUntilHdr, ResultsUntilInfer, ResultsUntilMask, ResultsUntilStokes
from polcap.stage_values import AngleStack, StokesImage, SurfaceMaps
from polcap.stages.align import object_motion
from polcap.stages.whitebalance import chart_in_mask

_LONGEST, _OUTLINE_PX, _OUTLINE_BLUR_PX = 256, 3.0, 2.0  # px of the reduced maps: side; band at the outline; blur
_DEGREES_PER_SHIFT = 200.0  # error of the normals per shift by the object's radius
_SIGMAS, _FALSE_SHIFT = 3.0, 0.003  # least significance of a shift; 1σ that polarization imitates, over the radius
_DEGREES_PER_TURN = 600.0  # error of the normals per shift of the surface by a turn, over the radius
_FALSE_TURN_DEG = 0.2  # 1σ of a turn that polarization imitates
_SHARP_PX, _DEGREES_PER_BLUR_PX = 1.2, 2.5  # greatest blur of sharp edges; error of the normals per px beyond it
_SMOOTH_OUTLINE = 1.1  # of the limit: smooth balls reach .96 of it, objects out of focus from 1.13 (10 objects)
_DEGREES_PER_FRAME_BLUR_PX = 9.0  # of a reference frame beyond the limit: 12° at 2.2 and 2.7 px, 24° at 4.6
_EDGE_FLOOR = 0.1  # of the object's median light: dark backdrops differ by less
_SAME_SCENE = 0.8  # correlation of detail that no two objects have: they reach .4
_STILL = 0.9  # correlation of detail that a shot has only if it moved by less than 1.5 px (docs/benchmarks/gates.md)
_LOCK = "Lock the camera, do not touch the object, and take that shot again"
_MOST_CONTRADICTION = 0.1  # of the object; set by hand: noise, glare and swapped angles leave less than .01
_TEXTURE = (
    "Put a ColorChecker or something else with texture next to the object, or use more light; of a locked camera, "
    "--set align.model=none"
)
_SAMPLED_PX = 1.0  # doubt of the outline that pixels alone cause: most of a thin object lies next to its outline
_HOLD_STILL = "Fix the object, do not touch it between shots, and take that shot again"
_HOLD_BOTH_STILL = "Fix the object and the chart, do not touch them between shots, and take that shot again"
_FOCAL_LENGTHS, _RADII = 9, 1000  # numbers of focal lengths in doubt, and of distances from the center in a table
_INWARD = 0.5  # sine of the zenith from which a normal leans inward: the inside of a bowl leans less at its lip
_INWARD_DEG = 25.0  # mean error of objects beyond the limit (docs/benchmarks/half-turns.md)


def alignment(found: Evidence[ResultsUntilAlign], limits: GateLimits) -> Gate:
    """Gate on movement between shots: of the camera, of the object against its surroundings, and turns of the object.

    The object is judged only if the camera passes. The first that does not pass is the gate. Shots of two objects, or
    of an object that something covers, contradict each other: more than all light would be polarized.
    """
    camera = _judge_camera(found, limits)
    if reaches(found, ResultsUntilStokes) and (share := _contradiction(found.results.stokes)) > _MOST_CONTRADICTION:
        return _one_object(found, share)
    blurred = np.nan_to_num(found.blur_px).max() > limits.max_blur_px  # looks like motion of the object
    if camera.state != "pass" or not reaches(found, ResultsUntilMask) or blurred:
        return camera
    shift, turn = _judge_shift(found, limits), _judge_turn(found, limits)
    worst = next((gate for gate in (shift, turn) if gate.state != "pass"), camera)
    return msgspec.structs.replace(worst, cost_deg=float(np.hypot(shift.cost_deg, turn.cost_deg)))


def _judge_camera(found: Evidence[ResultsUntilAlign], limits: GateLimits) -> Gate:
    """Gate on the movement of each shot, on its 1σ error and on the correlation of its detail with the first shot's."""
    measured, names, align = found.results.alignment, found.names, found.align
    height, width = found.results.radiance.value.shape[1:3]
    corners = picture_corners(width, height)
    moved = np.stack([transform_points(matrix, corners) for matrix in measured.transform])  # (K, 4, 2)
    shift, doubt = np.abs(moved - corners).max((1, 2)) * found.grid_px, measured.residual_px * found.grid_px
    correlation = measured.correlation
    most, most_doubt = align.max_shift_px, limits.max_align_residual_px * max(found.grid_px, 1)
    far, unlike, unsure = ~(shift <= most), correlation < align.min_correlation, doubt > most_doubt
    bad = far | unlike | unsure
    k = int(np.argmax(np.where(bad, 1e9, 0) + np.nan_to_num(shift)))  # the farthest, of the bad shots if there are any
    message, value = f"The {names[k]} shot moved by {shift[k]:.1f} ± {doubt[k]:.2f} px", round(float(shift[k]), 3)
    if not bad.any():
        message = message if shift[k] >= 0.05 else "No shot moved"  # less is 0.0 in the message
        return Gate("alignment", "pass", value, most, message, unit="px")
    if (odd := unlike | ~np.isfinite(shift)).any():
        return _another_scene(found, odd)
    failed = partial(Gate, "alignment", "fail", cost_deg=10.0, shots=bad_shots(names, bad), unit="px")
    if far[k]:
        return failed(value, most, message, remedy=_LOCK)
    message = f"{message}: it shares too little texture with the first one"
    least = correlation[unsure].min()
    remedy = _TEXTURE if least > _SAME_SCENE or unsure[1:].all() else _check_files(found, unsure)
    gate = failed(round(float(doubt[k]), 3), most_doubt, message, remedy=remedy)
    return msgspec.structs.replace(gate, state="warn") if least > _STILL else gate


def _another_scene(found: Evidence[ResultsUntilAlign], unlike: Bools) -> Gate:
    """Gate on shots (K,) that share no detail with the first one; if no shot does, the first is the odd one."""
    odd, least = _odd(unlike), found.align.min_correlation
    names = bad_shots(found.names, odd)
    message = f"The {' and '.join(names)} shot shows another scene than the others, or the camera moved far"
    value = round(float(found.results.alignment.correlation[unlike].min()), 3)
    return Gate("alignment", "fail", value, least, message, _check_files(found, odd), MOST_DEG, names, unit="")


def _contradiction(image: StokesImage) -> float:
    """Share of the lit object where the shots would need more polarized light than there is light."""
    s0, s1, s2 = (cv2.blur(np.ascontiguousarray(part, np.float32), (5, 5)) for part in frames.total(image.stokes))
    inside = lit(image) & (image.quality & int(Quality.OUTSIDE) == 0)
    return float((np.hypot(s1, s2) > s0)[inside].mean()) if inside.any() else 0.0


def _one_object(found: Evidence[ResultsUntilMask], share: float) -> Gate:
    """Gate on shots that contradict each other; the shot that resembles the others least is named."""
    light = np.log(np.maximum(frames.total(found.results.radiance.value), 1e-6))[:, found.results.object_.mask]
    with np.errstate(divide="ignore", invalid="ignore"):  # an even shot
        alike = np.nan_to_num(np.corrcoef(light)).sum(0)
    odd = np.arange(len(alike)) == int(np.argmin(alike))
    names = bad_shots(found.names, odd)
    message = f"The {names[0]} shot contradicts the others in {share:.0%} of the object: it shows another one, or moved"
    remedy = _check_files(found, odd)
    return Gate("alignment", "fail", share, _MOST_CONTRADICTION, message, remedy, MOST_DEG, names)


def _odd(unlike: Bools) -> Bools:
    """Flags (K,) of the odd shots, from flags of the shots that differ from the first one."""
    return ~unlike if unlike[1:].all() else unlike


def _check_files(found: Evidence[ResultsUntilHdr], odd: Bools) -> str:
    """Advice for shots (K,) that may be of another object."""
    folders = sorted({str(PurePath(files[0]).parent) for files, one in zip(found.files, odd) if one} - {"."})
    where = f" in {', '.join(folders)}" if folders else ""
    return f"Check the files of that shot{where}: are they of this object? Otherwise take the shot again"


def _judge_shift(found: Evidence[ResultsUntilMask], limits: GateLimits) -> Gate:
    """Gate on a shift of the object against its surroundings, with its error σ. Infinite: a shot of another object.

    It warns above 3 σ and a share of the object's radius. It fails if the shift less 3 σ exceeds a limit in px.
    """
    names, measured, limit = found.names, _measure_shift(found), limits.max_object_shift_px
    radius = max(outline.disc_radius(found.results.object_.mask) * found.grid_px, 1.0)
    length = np.nan_to_num(measured.length, posinf=np.inf) * found.grid_px
    sigma = measured.sigma * found.grid_px
    lower_limit = length - _SIGMAS * sigma
    least = limits.min_object_shift * radius
    unbiased = np.sqrt(np.maximum(length**2 - sigma**2, 0))
    cost = _DEGREES_PER_SHIFT * float(unbiased.max()) / radius
    k = int(np.argmax(lower_limit))
    figure = round(float(length[k]), 3)
    message = f"The object moved by {figure:.1f} ± {sigma[k]:.1f} px against its surroundings in {names[k]}"
    charted = found.results.color.place is not None  # the surroundings that moved may be the chart
    message += ", or the chart did" if charted else ""
    remedy = _HOLD_BOTH_STILL if charted else _HOLD_STILL
    bad = bad_shots(names, lower_limit > limit)
    moved = bad_shots(names, length > np.maximum(_SIGMAS * np.hypot(sigma, _FALSE_SHIFT * radius), least))
    if (unlike := np.isinf(length)).any():
        odd = _odd(unlike)
        other = bad_shots(names, odd)
        message = f"The {' and '.join(other)} shot shows another object in the same surroundings"
        return Gate("alignment", "fail", None, limit, message, _check_files(found, odd), MOST_DEG, other, "px")
    if bad:
        return Gate("alignment", "fail", figure, limit, message, remedy, max(cost, 5.0), bad, "px")
    if moved:
        return Gate("alignment", "warn", figure, least, message, remedy, cost, moved, "px")
    return Gate("alignment", "pass", figure, limit, message, cost_deg=cost, unit="px")


def _judge_turn(found: Evidence[ResultsUntilMask], limits: GateLimits) -> Gate:
    """Gate on a turn of the object between shots, beyond twice its error."""
    measured, names, limit = _measure_turn(found, limits), found.names, limits.max_object_turn_deg
    least = measured.degrees - 2 * np.hypot(measured.sigma, _FALSE_TURN_DEG)
    k = int(np.argmax(least))
    unbiased = np.sqrt(np.maximum(measured.shift**2 - measured.shift_sigma**2, 0))
    figure, cost = round(float(measured.degrees[k]), 3), _DEGREES_PER_TURN * float(unbiased.max())
    message = (
        f"The object turned by {figure:.1f}° ± {measured.sigma[k]:.1f}° in {names[k]}, as its visible detail shows"
    )
    if least[k] <= limit:
        return Gate("alignment", "pass", figure, limit, message, cost_deg=cost, unit="°")
    return Gate("alignment", "warn", figure, limit, message, _HOLD_STILL, cost, bad_shots(names, least > limit), "°")


def _measure_shift(found: Evidence[ResultsUntilMask]) -> object_motion.ObjectShift:
    """Shift of the object against its surroundings in each shot."""
    results = found.results
    return object_motion.measure(results.radiance, results.alignment, results.object_)


def _measure_turn(found: Evidence[ResultsUntilMask], limits: GateLimits) -> object_turn.ObjectTurn:
    """Turn of the object, by the depth of the maps only if these explain the photographs."""
    results, maps = found.results, None
    if reaches(found, ResultsUntilInfer) and rerendering.explains(found.rerendered, limits):
        maps = found.results.maps
    return object_turn.measure(results.radiance, results.alignment, results.object_, maps)


def mask(found: Evidence[ResultsUntilMask], limits: GateLimits) -> Gate:
    """Gate on the object's mask: a chart inside, uncertain pixels, contact with the picture's border, parts, holes."""
    object_, limit, doubt = found.results.object_, limits.max_mask_doubt, found.results.object_.doubt
    vague = doubt is not None and doubt * _width_px(object_.mask) > _SAMPLED_PX
    faults: list[tuple[str, float, float]] = []  # in words, its figure, its limit
    charted = _chart_share(found) if found.results.color.place is None else 0.0
    if charted:
        faults.append((f"{charted:.0%} of the object's mask looks like a color chart that was not found", charted, 0))
    doubted = doubt is not None and vague and doubt > limit
    if doubt is not None and vague and doubt > limit / 2:
        faults.append((f"About {100 * doubt:.0f} % of the mask may be wrong", doubt, limit if doubted else limit / 2))
    for message, figure, most in (
        ("The object touches {:.0%} of the picture's border, where it has no outline",
         object_.border, limits.max_mask_border),
        ("{:.0%} of the mask is separate from its largest part; one asset holds all",
         object_.islands, limits.max_mask_islands),
        ("The object's mask has holes of {:.0%} of its area", object_.holes, limits.max_mask_holes),
    ):  # fmt: skip
        if figure > most:
            faults.append((message.format(figure), figure, most))
    if not faults and doubt is not None:
        return Gate("mask", "pass", doubt, limit, f"About {100 * doubt:.1f} % of the outline may be wrong")
    if not faults:
        known = object_.source == "user"
        message = "The mask is the user's" if known else "The doubt of this mask is unknown"
        return Gate("mask", "pass" if known else "not measured", None, limit, message)
    state: State = "fail" if charted or doubted else "warn"
    remedy = (
        "Look at maps/mask.png; where it is wrong, draw one and use --mask PNG, or show backdrop all around the object"
    )
    if object_.islands > limits.max_mask_islands:
        remedy = f"Which object is it? --set mask.part=1 takes the largest, mask.part=2 the next. {remedy}"
    cost = 10 * object_.border if state == "warn" else 5.0
    _, value, most = faults[0]
    return Gate("mask", state, round(value, 5), most, "; ".join(fault[0] for fault in faults), remedy, cost)


def _width_px(mask: Bools) -> float:
    """Area of a mask over the number of its pixels at the outline [px]."""
    return float(mask.sum() / max(int((mask & ~erode(mask, 1)).sum()), 1))


def _chart_share(found: Evidence[ResultsUntilMask]) -> float:
    """Share of the object's mask that looks like a color chart."""
    return float(chart_in_mask.share(found.results.radiance, found.results.object_.mask, shipped_data.colorchecker()))


def mesh(surface: Mesh, limits: GateLimits) -> Gate:
    """Gate on the mesh: number of pieces, cuts, jagged boundary.

    The surface is cut where one part hides another, and where the normals are wrong. A jagged boundary is smoothed
    afterwards and does not change the normals, so alone it only warns.
    """
    faults: list[tuple[str, float, float, Unit]] = []  # in words, its figure, its limit
    remedies = []
    pieces, cuts, ragged = limits.max_mesh_pieces, limits.max_mesh_cuts, limits.max_mesh_raggedness
    if surface.pieces > pieces:
        faults.append((f"The mesh has {surface.pieces} pieces, more than {pieces}", surface.pieces, pieces, ""))
    if surface.cuts > cuts:
        message = (
            f"Cuts of {surface.cut_px:.0f} px are {surface.cuts:.0%} of the outline's length, more than {cuts:.0%}"
        )
        faults.append((message, surface.cuts, cuts, "1"))
    state: State = "fail" if faults else "warn"
    if faults:
        remedies.append("See the error of the normals: they fit no surface; --set surface.stiffness=0 closes all cuts")
    if surface.raggedness > ragged:
        message = f"The boundary is {surface.raggedness:.0%} longer than when smoothed, more than {ragged:.0%}"
        faults.append((message, surface.raggedness, ragged, "1"))
        remedies.append("If the mask's outline is jagged, use --mask PNG")
    if faults:
        _, value, limit, unit = faults[0]
        message = "; ".join(fault[0] for fault in faults)
        return Gate("mesh", state, round(value, 4), limit, message, "; ".join(remedies), unit=unit)
    message = f"{surface.pieces} {'piece' if surface.pieces == 1 else 'pieces'}, "
    where = f"cut along {surface.cut_px:.0f} px, at occlusions or where the normals are wrong"
    return Gate("mesh", "pass", round(surface.cuts, 4), cuts, message + (where if surface.cut_px else "without a cut"))


def sharpness(found: Evidence[ResultsUntilHdr], limits: GateLimits) -> Gate:
    """Gate on the blur of each frame relative to the sharpest frame of the same exposure.

    It fails if the reference frame of a shot is blurred, because ghosts take their light from it; others only warn.
    """
    blur, limit = found.blur_px, limits.max_blur_px
    if np.isnan(blur).all():
        return Gate("sharpness", "not measured", None, limit, "There is too little bright detail", unit="px")
    if reaches(found, ResultsUntilAlign) and not _show_one_place(found):
        return Gate("sharpness", "not measured", None, limit, "The shots show different places", unit="px")
    k, e = (int(i) for i in np.unravel_index(int(np.nanargmax(blur)), blur.shape))
    text = f"Frame {e + 1} of the {found.names[k]} shot is blurred by {{:.1f}} px more than the sharpest"
    message = worded(float(blur[k, e]), text, "All frames are equally sharp")
    unsharp = np.asarray(np.nan_to_num(blur) > limit)
    bad = bad_shots(found.names, np.asarray(unsharp.any(axis=1)))
    remedy = "Focus by hand and tape the ring, use a remote release, and take that shot again"
    if rescue := shot_exposure.leave_out(found, unsharp, limits):
        remedy = f"{rescue}; or take that shot again: focus by hand, tape the ring, use a remote release"
    reference = np.abs(np.log(found.results.radiance.bracket.exposure_ratio.mean(2))).argmin(1)  # (K,)
    worst = float(np.nan_to_num(blur)[np.arange(len(blur)), reference].max())
    cost = _DEGREES_PER_FRAME_BLUR_PX * max(worst - limit, 0.0)
    return at_most(
        "sharpness", float(blur[k, e]), limit, message, remedy, bad, cost, "px", "fail" if worst > limit else "warn"
    )


def _show_one_place(found: Evidence[ResultsUntilAlign]) -> bool:
    """Whether the tiles of all shots show the same detail, sharp or not."""
    moved = float(np.abs(found.results.alignment.transform[:, :2, 2]).max()) * found.grid_px
    return moved <= TILE / 2 and bool((found.results.alignment.correlation >= found.align.min_correlation).all())


def focus(found: Evidence[ResultsUntilMask], limits: GateLimits) -> Gate:
    """Gate on focus: blur of the sharpest edges of object, outline and chart, merged px; then that of the object.

    The outline of a smooth ball is never as sharp as a chart, so the object's own limit is higher.
    """
    limit, (of_object, of_chart) = limits.max_edge_blur_px, _edge_blurs(found)
    blur = float(np.fmin(of_object, of_chart))
    if found.grid_px > 1:
        return Gate("focus", "not measured", None, limit, "Only `process` measures this", unit="px")
    message = worded(blur, "The sharpest edges of the object are blurred by {:.1f} px (1σ)", "Edges are sharp")
    if blur > limit:
        message += ": all shots are out of focus, which costs about 0.04 of roughness"
    elif of_object > _SMOOTH_OUTLINE * limit:
        blur, limit = of_object, _SMOOTH_OUTLINE * limit
        message = f"The object's sharpest edges are blurred by {blur:.1f} px (1σ), the chart's by {of_chart:.1f} px: "
        message += "the object is out of focus"
    remedy = "Focus by hand on the front of the object, with f/8 to f/11"
    gate = at_most("focus", blur, limit, message, remedy, unit="px", beyond="warn")
    excess = max(blur - _SHARP_PX, 0.0) if np.isfinite(blur) else 0.0  # a smooth object looks the same
    return msgspec.structs.replace(gate, cost_deg=round(_DEGREES_PER_BLUR_PX * excess, 1))


def _edge_blurs(found: Evidence[ResultsUntilMask]) -> tuple[float, float]:
    """Blur (1σ) of the sharpest edges of the object and of the chart [px]; NaN without one."""
    radiance, mask, place = found.results.radiance, found.results.object_.mask, found.results.color.place
    of_object = _edge_blur(radiance, mask) if mask.any() else float("nan")
    if place is None or not mask.any():
        return of_object, float("nan")
    chart = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), place.corners.astype(np.int32), 1) > 0
    return of_object, _edge_blur(radiance, chart) if chart.any() else float("nan")


def _edge_blur(radiance: AngleStack, mask: Bools) -> float:
    """Blur (1σ) of the sharpest edges in and around a mask [px]: a step of height h, blurred by σ, has slope h/(σ√2π).

    Heights are ratios of light, so that the outline counts before a dark backdrop, however smooth the object is. Edges
    are the tenth of the mask with most contrast within 7 px; the sharpest are the twentieth of these.
    """
    light = np.maximum(radiance.value[0].sum(-1), 0)
    near = dilate(mask, 4)
    log = np.log(light + max(_EDGE_FLOOR * float(np.median(light[mask])), 1e-9)).astype(np.float32)
    window = np.ones((7, 7), np.uint8)
    height = (cv2.dilate(log, window) - cv2.erode(log, window))[near]
    slope = np.sqrt(squared_gradient(log))[near]
    edge = height >= np.percentile(height, 90)
    sharpest = np.percentile(slope[edge] / np.maximum(height[edge], 1e-9), 95)
    return float(1 / (np.sqrt(2 * np.pi) * max(float(sharpest), 1e-3)))


def focal_length(found: Evidence[ResultsUntilInfer]) -> Gate:
    """Gate on the focal length: an unknown or contradicted one tilts view rays and normals."""
    least, most = found.focal_doubt
    if not most - least:
        return Gate("focal length", "pass", "known", "known", "The focal length is known", unit="")
    cost = _median_ray_doubt_deg(found.results.maps, least, most)
    times = np.exp(max(most, -least))
    message = f"The focal length is in doubt and may be wrong by a factor of {times:.1f}, which bends shape and depth"
    remedy = (
        "State or correct focal_length_mm and sensor_width_mm in capture.toml, a text file in the capture's folder, "
        "or measure the lens with `polcap calibrate`"
    )
    return Gate("focal length", "warn", "in doubt", "known", message, remedy, round(cost, 1), unit="")


def inward_outline(found: Evidence[ResultsUntilInfer], limits: GateLimits) -> Gate:
    """Gate on inside-out shapes: share of the normals at the outline that point into the object.

    On a closed surface all of them point outwards.
    """
    share = _inward_share(found.results.maps)
    text = "{:.0f} % of the normals at the outline point into the object"
    message = worded(100 * share, text, "All normals at the outline point outwards")
    if share > limits.max_inward_outline:
        message += ": parts of the shape are inside out, most often on black gloss that mirrors its surroundings"
    remedy = (
        "Dull the object with chalk spray, or keep bright things and the backdrop away from it; "
        "where the mask is wrong, give --mask PNG"
    )
    return at_most("outline", share, limits.max_inward_outline, message, remedy, cost_deg=_INWARD_DEG)


def _inward_share(maps: SurfaceMaps) -> float:
    """Share of the normals within 3 px of the outline that point into the object, on maps of at most 256 px a side."""
    across = frames.to_ray_frame(maps.normal, frames.rays(maps.view, *maps.mask.shape))[..., :2]
    shrink = max(1.0, max(maps.mask.shape) / _LONGEST)
    shape = tuple(round(side / shrink) for side in maps.mask.shape)
    mask = area_mean(maps.mask, shape) > 0.99
    lean = area_mean((across * maps.mask[..., None]).astype(np.float32), shape)
    away, _slope = outline.outward(mask.astype(np.float32), _OUTLINE_BLUR_PX)
    band = rim.off_border(mask & (outline.depth(mask) <= _OUTLINE_PX))
    outwards = (lean[..., 0] * away[0] + lean[..., 1] * away[1])[band]
    return float((outwards < -_INWARD).mean()) if outwards.size else 0.0


def _median_ray_doubt_deg(maps: SurfaceMaps, least: float, most: float) -> float:
    """Change of a view ray's tilt [degrees] within the doubt of the focal length; median over the object."""
    return float(np.median(ray_doubt_deg(maps, least, most)[maps.mask])) if maps.mask.any() else 0.0


def ray_doubt_deg(maps: SurfaceMaps, least: float, most: float) -> Floats:
    """Root mean square change of each view ray's tilt (H, W) [degrees], if all focal lengths in doubt are as likely."""
    y, x = np.indices(maps.mask.shape)
    radius = np.hypot(x - maps.view.center[0], y - maps.view.center[1]) / maps.view.focal
    doubts = least + (most - least) * (np.arange(_FOCAL_LENGTHS) + 0.5) / _FOCAL_LENGTHS
    table = np.linspace(0, radius.max(), _RADII)
    changes = np.arctan(table * np.exp(-doubts[:, None])) - np.arctan(table)
    return np.asarray(np.interp(radius, table, np.degrees(np.sqrt((changes**2).mean(0)))))
