"""Limits of the gates: the section `gates` of the settings."""

from typing import Annotated

import msgspec
from msgspec import Meta


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Beyond a limit `check` asks to reshoot, and `process` writes the asset and ends with exit code 3."""

    max_delta_e: Annotated[float, Meta(gt=0, description="mean residual of the chart [CIEDE2000]")] = 5.0
    max_tone_curvature: Annotated[
        float, Meta(gt=0, le=1, description="change of an exposure ratio with brightness, ln over ln; 0 is linear [1]")
    ] = 0.1
    max_gain_disagreement: Annotated[
        float,
        Meta(gt=0, le=1, description="chart against object on a shot's light beyond both errors; 1 % costs 6° [1]"),
    ] = 0.03
    max_gain_doubt: Annotated[
        float, Meta(gt=0, le=1, description="1σ of a shot's light, or of the chart's gloss on it; 1 % is 6° [1]")
    ] = 0.006
    max_gain_change: Annotated[
        float, Meta(gt=0, le=1, description="of a shot's light against the other shots'; more is no ordinary pop [1]")
    ] = 0.1
    max_energy_drift: Annotated[
        float, Meta(gt=0, le=1, description="of one frame's light against its shot's and the other brackets' [1]")
    ] = 0.06
    max_align_residual_px: Annotated[
        float, Meta(gt=0, description="estimated 1σ error of a shot's registration [px of the grid]")
    ] = 0.15
    max_object_shift_px: Annotated[
        float,
        Meta(gt=0, description="of the object against its surroundings, shot to shot [px of the processed picture]"),
    ] = 1.5
    max_mask_doubt: Annotated[
        float, Meta(ge=0, le=1, description="1 − the overlap with the truth that the network expects; half warns [1]")
    ] = 0.25
    max_mask_islands: Annotated[
        float, Meta(ge=0, le=1, description="share of the object outside its largest part, to pass unnoticed [1]")
    ] = 0.02
    max_mask_holes: Annotated[
        float, Meta(ge=0, le=1, description="area of the object's holes, of its own, to pass unnoticed [1]")
    ] = 0.05
    max_mask_border: Annotated[
        float, Meta(ge=0, le=1, description="share of the picture's edge on the object, to pass unnoticed [1]")
    ] = 0.0
    max_clipped: Annotated[float, Meta(ge=0, le=1, description="share of the object that is clipped [1]")] = 0.02
    max_blur_px: Annotated[
        float,
        Meta(gt=0, le=20, description="1σ beyond the sharpest shot's; 0.6 px of the merged picture [RAW px]"),
    ] = 1.2
    max_turn_deg: Annotated[
        float,
        Meta(ge=3, le=45, description="of the polarizer away from the stated angle, told by the outline [degrees]"),
    ] = 8.0
    max_ring_turn_deg: Annotated[
        float,
        Meta(gt=0, le=45, description="of the ring's zero, by three angles: it may be a single shot's [degrees]"),
    ] = 3.0
    max_turn_fit: Annotated[
        float, Meta(gt=0, lt=1, description="misfit of the outline with that turn over without, to be believed [1]")
    ] = 0.68
    min_outline_dolp: Annotated[
        float, Meta(ge=0, le=1, description="median polarization of the outline; less is no common body [1]")
    ] = 0.03
    min_zenith_deg: Annotated[
        float,
        Meta(ge=0, le=90, description="median zenith of a weakly polarized shape; less is flattened [degrees]"),
    ] = 33.0
    max_inward_outline: Annotated[
        float, Meta(ge=0, le=1, description="share of the outline's normals that point into the object [1]")
    ] = 0.06
    min_concentration: Annotated[
        float, Meta(ge=0, le=1, description="how well polarization follows the outline, 1 is all round [1]")
    ] = 0.5
    max_one_sided: Annotated[
        float, Meta(gt=0, description="light of the outline going once round it, against its mean [1]")
    ] = 0.4
    max_side_light: Annotated[
        float, Meta(gt=0, le=1, description="one side of the outline brighter in one shot than in the others [1]")
    ] = 0.07
    max_dolp_noise: Annotated[
        float, Meta(gt=0, le=1, description="polarization that noise fakes in the object's median pixel [1]")
    ] = 0.04
    max_ambient: Annotated[
        float, Meta(gt=0, le=1, description="share of the light that is there without the flash [1]")
    ] = 0.1
    max_crossed_misfit: Annotated[
        float, Meta(gt=0, le=1, description="share of the object brighter in the cross-polarized shot than in S0 [1]")
    ] = 0.05
    max_ill_posed: Annotated[
        float, Meta(ge=0, le=1, description="share of the object whose DoLP no dielectric can have [1]")
    ] = 0.05
    max_ghost: Annotated[
        float, Meta(ge=0, le=1, description="share of a shot whose exposures disagree beyond noise [1]")
    ] = 0.02
    max_normal_error_deg: Annotated[
        float, Meta(gt=0, le=90, description="median expected error of the normals [degrees]")
    ] = 20.0
    max_mesh_pieces: Annotated[int, Meta(ge=1, description="pieces of the seen surface, without specks")] = 10
    max_mesh_cuts: Annotated[
        float, Meta(ge=0, description="length of the cuts where depth jumps, both sides, over the outline's [1]")
    ] = 2.0
    max_mesh_raggedness: Annotated[
        float, Meta(ge=0, description="how much longer the mesh's rim is than its smooth curve [1]")
    ] = 0.25
