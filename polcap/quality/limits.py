"""Limits of the gates: the section `gates` of the settings."""

from typing import Annotated

import msgspec
from msgspec import Meta


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Beyond a limit, `check` asks for new photographs, and `process` writes the asset but ends with exit code 3.

    One flat list, because each gate has its own limit.
    """

    max_delta_e: Annotated[float, Meta(gt=0, description="mean color error of the chart [CIEDE2000]")] = 5.0
    max_tone_curvature: Annotated[
        float, Meta(gt=0, le=1, description="change of an exposure ratio with brightness, ln over ln; 0 is linear [1]")
    ] = 0.1
    max_gain_disagreement: Annotated[
        float,
        Meta(
            gt=0, le=1, description="difference of chart and object on a shot's light beyond both errors; 1 % is 6° [1]"
        ),
    ] = 0.03
    max_gain_doubt: Annotated[
        float, Meta(gt=0, le=1, description="1σ error of a shot's light, or effect of the chart's gloss; 1 % is 6° [1]")
    ] = 0.006
    max_gain_change: Annotated[
        float, Meta(gt=0, le=1, description="difference of a shot's light from that of the others [1]")
    ] = 0.1
    max_energy_drift: Annotated[
        float, Meta(gt=0, le=1, description="difference of one frame's light from its shot and the other brackets [1]")
    ] = 0.06
    max_align_residual_px: Annotated[
        float, Meta(gt=0, description="estimated 1σ error of a shot's registration [px of the grid]")
    ] = 0.15
    max_object_shift_px: Annotated[
        float,
        Meta(gt=0, description="movement of the object in front of its background between shots [merged px]"),
    ] = 1.5
    max_mask_doubt: Annotated[
        float, Meta(ge=0, le=1, description="1 − expected overlap with the true mask; half of it warns [1]")
    ] = 0.25
    max_mask_islands: Annotated[
        float, Meta(ge=0, le=1, description="share of the object outside its largest part; more warns [1]")
    ] = 0.02
    max_mask_holes: Annotated[
        float, Meta(ge=0, le=1, description="area of the holes relative to the object; more warns [1]")
    ] = 0.05
    max_mask_border: Annotated[
        float, Meta(ge=0, le=1, description="share of the picture's border covered by the object; more warns [1]")
    ] = 0.0
    max_clipped: Annotated[float, Meta(ge=0, le=1, description="share of the object that is clipped [1]")] = 0.02
    max_blur_px: Annotated[
        float,
        Meta(gt=0, le=20, description="blur 1σ beyond that of the sharpest shot [RAW px]"),
    ] = 1.2
    max_turn_deg: Annotated[
        float,
        Meta(ge=3, le=45, description="polarizer angle minus stated angle, from the outline [degrees]"),
    ] = 8.0
    max_ring_turn_deg: Annotated[
        float,
        Meta(
            gt=0, le=45, description="zero error of the ring from three angles, where one shot may cause it [degrees]"
        ),
    ] = 3.0
    max_turn_fit: Annotated[
        float,
        Meta(
            gt=0,
            lt=1,
            description="misfit with an angle error over misfit without it; below, the error is reported [1]",
        ),
    ] = 0.68
    min_outline_dolp: Annotated[
        float, Meta(ge=0, le=1, description="median polarization of the outline; less is no usual material [1]")
    ] = 0.03
    min_zenith_deg: Annotated[
        float,
        Meta(ge=0, le=90, description="median zenith angle of a weakly polarized shape; less is too flat [degrees]"),
    ] = 33.0
    max_inward_outline: Annotated[
        float, Meta(ge=0, le=1, description="share of the outline's normals that point into the object [1]")
    ] = 0.06
    min_concentration: Annotated[
        float, Meta(ge=0, le=1, description="agreement of polarization and outline; 1 is perfect [1]")
    ] = 0.5
    max_one_sided: Annotated[
        float, Meta(gt=0, description="brightness variation along the outline, relative to its mean [1]")
    ] = 0.4
    max_side_light: Annotated[
        float, Meta(gt=0, le=1, description="extra brightness of one side of the outline in one shot [1]")
    ] = 0.07
    max_dolp_noise: Annotated[
        float, Meta(gt=0, le=1, description="false polarization from noise, median of the object [1]")
    ] = 0.04
    max_ambient: Annotated[
        float, Meta(gt=0, le=1, description="share of the light that is present without the flash [1]")
    ] = 0.1
    max_crossed_misfit: Annotated[
        float, Meta(gt=0, le=1, description="share of the object brighter in the cross-polarised shot than in S0 [1]")
    ] = 0.05
    max_ill_posed: Annotated[
        float, Meta(ge=0, le=1, description="share of the object with more DoLP than any dielectric [1]")
    ] = 0.05
    max_ghost: Annotated[
        float, Meta(ge=0, le=1, description="share of a shot with exposures that differ by more than noise [1]")
    ] = 0.02
    max_normal_error_deg: Annotated[
        float, Meta(gt=0, le=90, description="median expected error of the normals [degrees]")
    ] = 20.0
    max_mesh_pieces: Annotated[int, Meta(ge=1, description="separate pieces of the surface, without specks")] = 10
    max_mesh_cuts: Annotated[
        float, Meta(ge=0, description="length of the cuts at depth jumps, both sides, over the outline's length [1]")
    ] = 2.0
    max_mesh_raggedness: Annotated[
        float, Meta(ge=0, description="length of the mesh's border over its smoothed length, minus 1 [1]")
    ] = 0.25
