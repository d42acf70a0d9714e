"""Limits of the gates: the section `gates` of the settings."""

from typing import Annotated

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
PositiveShare = Annotated[float, Meta(gt=0, le=1)]


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the quality gates.

    If a value is beyond its limit, `check` asks to reshoot, and `process` writes the asset and ends with exit code 3.
    """

    max_delta_e: Annotated[
        Positive, Meta(description="allowed mean color error of the chart's patches [CIEDE2000]")
    ] = 5.0
    max_scale_doubt: Annotated[PositiveShare, Meta(description="allowed 1σ of the scale of all albedos [1]")] = 0.2
    max_tone_curvature: Annotated[
        PositiveShare, Meta(description="allowed slope of ln exposure ratio over ln brightness; 0 is linear [1]")
    ] = 0.1
    max_flicker: Annotated[
        PositiveShare, Meta(description="allowed change of the light from row to row of a picture, RMS [1]")
    ] = 0.004
    max_black_error: Annotated[
        PositiveShare, Meta(description="allowed error of the stated black level, which is corrected [white level]")
    ] = 0.001
    max_gain_disagreement: Annotated[
        PositiveShare,
        Meta(description="allowed difference of a shot's gain by chart and by object, beyond both errors [1]"),
    ] = 0.03
    max_gain_doubt: Annotated[
        PositiveShare, Meta(description="allowed 1σ of the gain of a shot; 1 % costs 6° of the normals [1]")
    ] = 0.006
    max_gain_change: Annotated[
        PositiveShare,
        Meta(
            description="allowed change of the light from shot to shot. A darker shot only warns: its gain is measured "
            "and corrected. A brighter shot fails: another lamp may have been on [1]"
        ),
    ] = 0.1
    max_energy_drift: Annotated[
        PositiveShare, Meta(description="allowed change of one frame's light against its bracket [1]")
    ] = 0.06
    max_align_residual_px: Annotated[
        Positive, Meta(description="allowed 1σ error of a shot's registration [merged px]")
    ] = 0.15
    min_object_shift: Annotated[
        PositiveShare, Meta(description="least movement of the object that is reported [radius of the object]")
    ] = 0.01
    max_object_shift_px: Annotated[
        Positive, Meta(description="allowed movement of the object against its surroundings [merged px]")
    ] = 1.5
    max_object_turn_deg: Annotated[
        float,
        Meta(gt=0, le=45, description="allowed turn of the object between shots, beyond twice its error [degrees]"),
    ] = 0.45
    max_mask_doubt: Annotated[
        Share, Meta(description="allowed expected error of the mask, 1 − overlap; half of it warns [1]")
    ] = 0.25
    max_mask_islands: Annotated[Share, Meta(description="allowed share of the mask outside its largest part [1]")] = (
        0.02
    )
    max_mask_holes: Annotated[Share, Meta(description="allowed area of holes relative to the mask [1]")] = 0.05
    max_mask_border: Annotated[
        Share, Meta(description="allowed share of the picture's border that the object touches [1]")
    ] = 0.0
    max_clipped: Annotated[Share, Meta(description="allowed share of the object that is clipped [1]")] = 0.02
    max_blur_px: Annotated[
        float, Meta(gt=0, le=20, description="allowed 1σ of a frame's blur beyond the sharpest frame [RAW px]")
    ] = 1.2
    max_edge_blur_px: Annotated[
        float, Meta(gt=0, le=20, description="allowed 1σ blur of the object's sharpest edges [merged px]")
    ] = 1.4
    max_turn_deg: Annotated[
        float, Meta(ge=3, le=45, description="allowed error of an angle, measured from the outline [degrees]")
    ] = 8.0
    max_ring_turn_deg: Annotated[
        float, Meta(gt=0, le=45, description="allowed error of the ring's zero, with three angles [degrees]")
    ] = 3.0
    max_turn_fit: Annotated[
        float, Meta(gt=0, lt=1, description="a turn is reported if it lowers the outline's misfit below this share [1]")
    ] = 0.68
    min_outline_dolp: Annotated[Share, Meta(description="least allowed median polarization of the outline [1]")] = 0.03
    min_zenith_deg: Annotated[
        float,
        Meta(
            ge=0, le=90, description="least allowed median tilt of the normals, for a weakly polarized object [degrees]"
        ),
    ] = 33.0
    max_inward_outline: Annotated[
        Share, Meta(description="allowed share of the outline's normals that point into the object [1]")
    ] = 0.12
    min_concentration: Annotated[
        Share, Meta(description="least allowed agreement of polarization and outline; 1 is perfect [1]")
    ] = 0.5
    max_side_light: Annotated[PositiveShare, Meta(description="allowed excess light on one side in one shot [1]")] = (
        0.07
    )
    max_dolp_noise: Annotated[
        PositiveShare, Meta(description="allowed false polarization from noise, median over the object [1]")
    ] = 0.04
    max_ambient: Annotated[
        PositiveShare, Meta(description="allowed share of ambient light, which is subtracted [1]")
    ] = 0.3
    max_ambient_shared: Annotated[
        PositiveShare, Meta(description="allowed share of ambient light if one ambient frame serves several angles [1]")
    ] = 0.08
    max_highlight_dolp: Annotated[
        PositiveShare, Meta(description="allowed polarization common to the brightest parts that face the camera [1]")
    ] = 0.004
    max_albedo_slope: Annotated[
        Positive, Meta(description="allowed change of ln albedo per unit of the normal's x and y, towards one side [1]")
    ] = 0.15
    max_room_dolp: Annotated[
        PositiveShare, Meta(description="allowed polarization of the surroundings, common to all of them [1]")
    ] = 0.015
    max_crossed_misfit: Annotated[
        PositiveShare,
        Meta(description="allowed share of the object that is brighter in the cross-polarized shot than in S0 [1]"),
    ] = 0.05
    max_ill_posed: Annotated[
        Share, Meta(description="allowed share of the object with a DoLP above that of any dielectric [1]")
    ] = 0.05
    min_rerendering_agreement: Annotated[
        Share,
        Meta(description="least agreement of the photographs' polarization with that of the maps; 1 is perfect [1]"),
    ] = 0.2
    max_rerendering_scale: Annotated[
        float,
        Meta(ge=1, description="largest factor between the brightness of the photographs and that of the maps [1]"),
    ] = 1.7
    max_ghost: Annotated[
        Share, Meta(description="allowed share of the object where exposures of a shot disagree beyond noise [1]")
    ] = 0.02
    max_normal_error_deg: Annotated[
        float, Meta(gt=0, le=90, description="allowed median expected error of the normals [degrees]")
    ] = 20.0
    max_mesh_pieces: Annotated[int, Meta(ge=1, description="allowed number of pieces of the mesh")] = 10
    max_mesh_cuts: Annotated[
        float, Meta(ge=0, description="allowed length of both sides of all cuts, relative to the outline [1]")
    ] = 2.0
    max_mesh_raggedness: Annotated[
        float, Meta(ge=0, description="allowed excess length of the mesh's boundary over its smoothed curve [1]")
    ] = 0.25


class FusedGateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the gates of a fused object, the section `fusion.gates`."""

    min_views: Annotated[int, Meta(ge=3, le=999, description="least number of views without a warning")] = 8
    max_corner_px: Annotated[
        Positive, Meta(description="allowed rms reprojection error of board corners; usually 0.1 to 0.2 [RAW px]")
    ] = 0.5
    max_feature_px: Annotated[
        Positive,
        Meta(description="without a board: allowed rms reprojection error of features; usually 0.6 to 1 [RAW px]"),
    ] = 2.0
    max_normal_deg: Annotated[
        float,
        Meta(gt=0, le=90, description="allowed median angle between a view's normals and the mesh; usually 6 to 9 [°]"),
    ] = 20.0
    min_shared: Annotated[
        Share,
        Meta(
            description="least share of a further set's surface that the first set confirms; less ends the run. "
            "Sets of one object have .84 or more, of two objects mostly .5 or less [1]"
        ),
    ] = 0.7
    min_seen: Annotated[Share, Meta(description="least share of the surface that a view saw [1]")] = 0.85


class MaterialGateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the gates of a flat sample, the section `material.gates`."""

    min_views: Annotated[int, Meta(ge=3, le=999, description="least number of views without a warning")] = 5
    max_corner_px: Annotated[
        Positive, Meta(description="allowed rms reprojection error of board corners; usually 0.1 to 0.2 [RAW px]")
    ] = 0.5
    max_paper_shine: Annotated[
        Positive, Meta(description="allowed highlight of the board's paper over its diffuse light [1]")
    ] = 0.1
    max_blur_px: Annotated[
        Positive, Meta(description="allowed blur of a view beyond that of the median view, 1σ; usually 0.2 [merged px]")
    ] = 0.5
    max_residual: Annotated[
        Positive,
        Meta(description="allowed median of a view's radiance minus that of the fit, relative; usually 0.01 [1]"),
    ] = 0.05
    min_seen: Annotated[
        Share, Meta(description="least share of the texels that three views or more have measured [1]")
    ] = 0.95
    min_tilt_deg: Annotated[
        float, Meta(ge=0, le=90, description="least tilt of the most oblique view against the steepest [°]")
    ] = 15.0
