"""Stage 8: normals and material from the cues, by network or by analytic inversion.

Both estimators work in the frame of each view ray, where polarization depends on the surface alone, and return maps in
the camera frame.

    learned        the network, joined with the inversion
        augmentation   its predictions in turned and mirrored positions, averaged
        fine           relief finer than its pixels, by a second network
    analytic       the inversion: zenith from DoLP, azimuth from AoLP
        zenith         by the object's law of diffuse polarization
    half_turns     the side of the ray to which a normal leans, for both estimators
    albedo         in highlights, its uncertain scale, and its detail finer than a superpixel
"""

from dataclasses import replace
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from polcap.images import Cues, Network, RunNetwork, SurfaceMaps
from polcap.stages import stage
from polcap.stages.infer import albedo, analytic, learned


class InferSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `infer`, the section `infer` of a settings file."""

    ior: Annotated[float, Meta(ge=1.2, le=2.5, description="refractive index assumed by the analytic estimator")] = 1.5
    symmetries: Annotated[
        Literal[1, 2, 4, 8],
        Meta(description="number of turned and mirrored positions that the network sees"),
    ] = 4
    fine: Annotated[bool, Meta(description="a second network adds relief finer than the pixels of the first")] = True


@stage(version=23)
def estimate(cues: Cues, network: Network | None, run: RunNetwork, settings: InferSettings) -> SurfaceMaps:
    """Estimate normal, diffuse, specular, roughness and expected error from cues; without a network by inversion.

    Raises
    ------
    ModelError
        The network was made for other channels.
    """
    if network is None:
        maps = analytic.estimate(cues, settings.ior)
    else:
        maps = learned.estimate(cues, network, run, settings.ior, settings.symmetries, fine_pass=settings.fine)
    maps = albedo.correct_highlights(maps, cues, settings.ior)
    return replace(
        maps,
        albedo_sigma=albedo.albedo_sigma(maps, cues.scale_sigma),
        detail=None if cues.detail is None else albedo.select_detail(cues.detail, cues, maps),
    )
