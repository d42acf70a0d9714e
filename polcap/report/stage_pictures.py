"""Pictures of each stage's result, (H, W, 3) uint8 sRGB, for people to check.

Color codes (`keys.py`): normals as n·½+½ (x right is red, y up is green); AoLP as hue, 0° is red and 180° run once
around the wheel; DoLP, depth and errors from dark (small) to bright (large).
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.chart_values import ChartReference, ColorCalibration
from polcap.image_values import Bools, Floats, Quality
from polcap.mesh_values import Asset, ReliefMesh
from polcap.optics import color, frames
from polcap.optics import outline as outlines
from polcap.optics.resize import area_mean
from polcap.optics.warp import warp
from polcap.report import keys
from polcap.report.sheets import WIDTH, Tile, sheet, write
from polcap.report.sheets import Picture as Picture
from polcap.results import FirstResults, ResultsUntilHdr
from polcap.stage_values import Alignment, AngleStack, Cues, Gains, ObjectMask, StokesImage, SurfaceMaps
from polcap.stages.whitebalance import chart_search

_RED = (230, 40, 30)


def of_stage(results: FirstResults, stage: str) -> Picture:
    """Picture of the result of a stage that the path has reached, for people to check."""
    draw: dict[str, Callable[[Any], Picture | list[Tile]]] = {
        "hdr": lambda found: _merged(found.radiance),
        "whitebalance": lambda found: chart(found.radiance, found.color),
        "align": lambda found: registered(found.radiance, found.alignment),
        "mask": lambda found: outline(found.radiance, found.color, found.object_),
        "selfcal": lambda found: _gains(found.selfcal.gains, found.radiance.angle),
        "stokes": lambda found: _stokes(found.stokes),
        "cues": lambda found: _cues(found.cues),
        "infer": lambda found: _maps(found.maps),
        "surface": lambda found: _surface(found.mesh, found.maps),
    }
    drawn = draw[stage](results)
    return sheet(drawn) if isinstance(drawn, list) else drawn


def stopped(results: ResultsUntilHdr, colors: ChartReference | None) -> Picture:
    """Picture of the shots of a path that an error ended: red where all exposures are clipped.

    `colors` are those of a chart that was not found; then the first shot shows the patches of all its candidates.
    """
    radiance, tiles = results.radiance, []
    for k, degrees in enumerate(np.degrees(radiance.angle)):
        shot = shrink(radiance.value[k], 2 * WIDTH)
        clipped = (radiance.quality[k] & int(Quality.CLIPPED)) > 0
        picture = display(shot)
        picture[area_mean(clipped, picture.shape) > 0.5] = _RED
        if k == 0 and colors is not None:
            zoom = picture.shape[1] / radiance.value.shape[2]
            for centers, _cost in chart_search.candidates(radiance.value[0], colors.is_block):
                for x, y in np.round((centers + 0.5) * zoom - 0.5).astype(int).tolist():
                    cv2.drawMarker(picture, (x, y), (255, 255, 0), cv2.MARKER_CROSS, 8)
        tiles.append(Tile(picture, f"{degrees:g}° shot", note=f"red: {100 * clipped.mean():.1f} % are clipped"))
    return sheet(tiles)


def reference(radiance: AngleStack, color: ColorCalibration, widest: int | None = None) -> Picture:
    """The reference shot in calibrated colors, at most `widest` px wide."""
    first = radiance.value[0]
    reduced = np.asarray(first if widest is None else shrink(first, widest), np.float32)
    return display(cv2.transform(reduced, 2 * color.matrix.astype(np.float32)))  # a shot has half of S0


def chart(radiance: AngleStack, color: ColorCalibration, widest: int | None = None) -> Picture:
    """Picture of the reference shot with the outlines of the detected chart patches."""
    picture = reference(radiance, color, widest)
    copies = max(1, round(2 * WIDTH / picture.shape[1]))  # of each pixel, along both sides
    picture = np.asarray(picture.repeat(copies, 0).repeat(copies, 1), np.uint8)
    zoom = picture.shape[1] / radiance.value.shape[2]
    if color.place is not None:
        outlines = [(quad, (0, 255, 0)) for quad in color.place.quads] + [(color.place.corners, (255, 255, 0))]
        for corners, paint in outlines:
            points = np.round((corners + 0.5) * zoom - 0.5).astype(np.int32)
            cv2.polylines(picture, [points], True, paint, 1, cv2.LINE_AA)
    return picture


def registered(radiance: AngleStack, found: Alignment) -> list[Tile]:
    """Pictures of each registered shot (green) over the reference shot (magenta); gray where both agree."""
    first = _gray(shrink(radiance.value[0], 2 * WIDTH))
    zoom = np.diag([*np.divide(first.shape[::-1], radiance.value.shape[2:0:-1]), 1.0])
    zoom[:2, 2] = (zoom.diagonal()[:2] - 1) / 2  # pixel centers are whole numbers
    tiles = []
    for k, degrees in list(enumerate(np.degrees(radiance.angle)))[1:]:
        shot = _gray(shrink(radiance.value[k], 2 * WIDTH))
        on_first = warp(shot, zoom @ found.transform[k] @ np.linalg.inv(zoom), order=1)
        moved = display(np.stack([first, on_first, first], -1), _top(first))
        x, y = found.transform[k, :2, 2]
        caption = f"{degrees:g}° shot moved by {x:+.2f}, {y:+.2f} ± {found.residual_px[k]:.3f} px"
        tiles.append(Tile(moved, caption, note="first shot magenta, this shot green: gray where both agree"))
    return tiles


def outline(radiance: AngleStack, color: ColorCalibration, object_: ObjectMask, widest: int | None = None) -> Picture:
    """Picture of the reference shot, darkened outside the mask, with the box of the crop."""
    picture = reference(radiance, color, widest)
    outside = area_mean(object_.mask, picture.shape) < 0.5
    picture[outside] = picture[outside] // 3
    x0, y0, x1, y1 = (round(edge * picture.shape[1] / radiance.value.shape[2]) for edge in object_.crop)
    cv2.rectangle(picture, (x0, y0), (x1 - 1, y1 - 1), (255, 255, 0), 2)
    return picture


def normal(found: SurfaceMaps) -> Picture:
    """Picture of a normal map as colors, black outside the object."""
    return cut_out(_eight_bits(found.normal / 2 + 0.5), found.mask)


def cut_out(picture: Picture, mask: Bools) -> Picture:
    """A picture that blends into black at the object's outline."""
    continued = outlines.fill_outward(picture, mask)
    return np.asarray(np.rint(continued * outlines.matte(mask)[..., None]), np.uint8)


def shaded(mesh: ReliefMesh, found: SurfaceMaps) -> Picture:
    """Picture of the shape without colors: the normals of the depth map under a light from the upper left."""
    inside = np.isfinite(mesh.depth)
    depth = np.where(inside, mesh.depth, np.nan)
    footprint = np.nanmedian(depth) / found.view.focal if inside.any() else 1.0  # size of a pixel there
    down, right = np.gradient(depth / footprint)
    facing = np.stack([right, -down, np.ones_like(depth)], -1)  # z towards the camera, y up
    light = np.array([-0.5, 0.6, 0.62])
    cosine = facing @ (light / np.linalg.norm(light)) / np.linalg.norm(facing, axis=-1)
    shade = np.clip(np.nan_to_num(cosine), 0, 1)
    return _eight_bits(np.repeat((0.1 + 0.85 * shade)[..., None], 3, -1) * inside[..., None])


def display(linear: Floats, top: float | None = None) -> Picture:
    """Convert linear light to sRGB for display; `top` becomes white, by default the 99.5th percentile."""
    return color.srgb_eight_bits(np.asarray(linear, np.float32) / np.float32(top or _top(linear)))


def scale(value: Floats, low: float, high: float, inside: Bools) -> Picture:
    """Convert values low…high to colors from dark to bright, black outside the object."""
    return keys.ColorKey(low, max(high, low + 1e-12), "", (), "inferno").picture(value, inside)


def hue(aolp: Floats, inside: Bools) -> Picture:
    """Convert an angle of polarization (modulo π) to a hue."""
    return keys.AOLP.picture(np.degrees(aolp) % 180, inside)


def shrink(picture: NDArray[Any], width: int) -> NDArray[Any]:
    """Reduce a picture (H, W, …) by averaging to at most `width` pixels wide."""
    tall, wide = picture.shape[:2]
    if wide <= width:
        return picture
    return area_mean(picture, (max(1, round(tall * width / wide)), width))


def _merged(radiance: AngleStack) -> list[Tile]:
    """Pictures of every merged shot; clipped pixels red, pixels with motion magenta."""
    top = _top(radiance.value[0])
    tiles = []
    for value, quality, angle in zip(radiance.value, radiance.quality, np.degrees(radiance.angle)):
        tile = display(value, top)
        tile[(quality & int(Quality.CLIPPED)) > 0] = (255, 40, 40)
        tile[(quality & int(Quality.GHOST)) > 0] = (255, 0, 255)
        note = "not white-balanced; red: clipped in every exposure; magenta: moved"
        tiles.append(Tile(tile, f"Polarizer at {angle:g}°", note=note))
    return tiles


def _gains(found: Gains, angle: Floats) -> Picture:
    """Plot of the shots' gains with 1σ, as a picture. Crosses are the gains measured on the object itself."""
    height, left = 60 * len(found.gain) + 40, 120
    picture = np.full((height, WIDTH, 3), 255, np.uint8)
    span = max(0.02, 1.2 * float(np.abs(np.stack([found.gain, found.anchor]) - 1).max()))

    def column(gain: float) -> int:
        return int(left + (WIDTH - left - 20) * (0.5 + 0.5 * np.clip((gain - 1) / span, -1, 1)))

    cv2.line(picture, (column(1), 10), (column(1), height - 30), (180, 180, 180), 1)
    for shot, degrees in enumerate(np.degrees(angle)):
        write(picture, f"{degrees:g}°", (10, 45 + 60 * shot), (0, 0, 0))
        for channel, paint in enumerate([(200, 0, 0), (0, 140, 0), (0, 0, 200)]):
            row = 25 + 60 * shot + 14 * channel
            gain, sigma = float(found.gain[shot, channel]), float(found.sigma[shot, channel])
            cv2.line(picture, (column(gain - sigma), row), (column(gain + sigma), row), paint, 2)
            cv2.circle(picture, (column(gain), row), 4, paint, -1)
            anchor = (column(float(found.anchor[shot, channel])), row)
            cv2.drawMarker(picture, anchor, paint, cv2.MARKER_CROSS, 10, 1)
    note = f"1 ± {span:.3f}, from {found.source}; crosses: pixels facing the camera"
    write(picture, note, (left, height - 10), (0, 0, 0), 17)
    return picture


def _stokes(image: StokesImage) -> list[Tile]:
    """Pictures of S0 in camera channels, DoLP and AoLP."""
    s0, s1, s2 = frames.total(image.stokes)
    dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-6)
    tile = Tile(display(image.stokes[0]), "S0", note="camera channels, brightest parts white")
    return [tile, *polarization(dolp, np.arctan2(s2, s1) / 2, image.mask)]


def _cues(found: Cues) -> list[Tile]:
    """Pictures of the inputs of the estimators: S0, DoLP, AoLP, normalized Stokes parameters, diffuse color, noise."""
    cos, sin = found.normalized_stokes
    inside = found.mask[..., None]
    normalized = _eight_bits(np.stack([np.full_like(cos, 0.5), cos / 2 + 0.5, sin / 2 + 0.5], -1) * inside)
    return [
        Tile(display(found.radiance), "S0", note="calibrated colors, brightest parts white"),
        *polarization(found.dolp, np.arctan2(sin, cos) / 2, found.mask),
        Tile(normalized, "Normalized Stokes parameters", note="green S1, blue S2: 0.5 is zero"),
        Tile(display(found.diffuse_color * inside, 1.0), "Diffuse color", note="normalized to unit length"),
        Tile(keys.SIGMA.picture(found.ratio_sigma, found.mask), "Noise of S1/S0 and S2/S0, 1σ", keys.SIGMA),
    ]


def polarization(dolp: Floats, aolp: Floats, inside: Bools) -> list[Tile]:
    """Tiles of DoLP and of AoLP [rad] (H, W), black outside the object."""
    return [
        Tile(keys.DOLP.picture(dolp, inside), "Degree of linear polarization", keys.DOLP),
        Tile(hue(aolp, inside), "Angle of linear polarization", keys.AOLP),
    ]


def _maps(found: SurfaceMaps) -> list[Tile]:
    """Tiles of the picture of the stage `infer`."""
    inside = found.mask
    specular, rough = display(found.specular, keys.F0.high), keys.ROUGHNESS.picture(found.roughness, inside)
    error = keys.ERROR.picture(found.confidence, inside)
    return [
        Tile(normal(found), "Normal", note="red right, green up, blue toward the camera"),
        Tile(cut_out(display(found.diffuse, 1.0), inside), "Diffuse albedo", note="white: 1"),
        Tile(cut_out(specular, inside), "Specular albedo F0", note=f"white: {keys.F0.high:g}"),
        Tile(cut_out(rough, inside), "Roughness", keys.ROUGHNESS),
        Tile(cut_out(error, inside), "Expected error of the normal", keys.ERROR),
    ]


def _surface(mesh: ReliefMesh, found: SurfaceMaps) -> list[Tile]:
    """Pictures of the depth map and of its shaded shape."""
    inside = np.isfinite(mesh.depth)
    depth = mesh.depth * (1000.0 if mesh.metric else 1.0)
    key = keys.depth(depth[inside], mesh.metric)
    note = "normals of the depth map, under a light from the upper left"
    return [Tile(key.picture(depth, inside), "Depth", key), Tile(shaded(mesh, found), "Shape", note=note)]


def textures(built: Asset) -> Picture:
    """Picture of the textures as stored in the glTF file."""
    specular_note = f"white is {max(built.specular_factor):.3g} × F0 of the index"
    return sheet(
        [
            Tile(built.base_color, "Base color", note="sRGB"),
            Tile(built.normal, "Normal", note="tangent space, +Y"),
            Tile(built.occlusion_roughness_metallic, "Occlusion, roughness, metallic", note="red, green, blue"),
            Tile(built.specular_color, "Specular color", note=specular_note),
        ]
    )


def _top(linear: Floats) -> float:
    return max(float(np.percentile(linear[::4, ::4], 99.5)), 1e-6)


def _gray(value: Floats) -> Floats:
    return np.asarray(frames.total(value) / 3, np.float32)


def _eight_bits(value: Any) -> Picture:
    return np.asarray(np.round(np.clip(value, 0, 1) * 255), np.uint8)
