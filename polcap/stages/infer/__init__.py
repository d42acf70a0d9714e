"""Stage 8: estimate the surface's normals and material from the cues, by network or by inversion.

Both estimators work in the frame of each view ray, where polarization speaks of the surface alone, and
hand back camera-frame maps.

    analytic       the inversion: zenith from DoLP, azimuth from AoLP
        zenith         zenith from DoLP, by the object's law of diffuse polarization
    half_turns     side of the ray to which a normal leans, for both estimators
    highlight_albedo   albedo in highlights, from a crossed shot
    learned        the network, joined with the inversion
    fine           relief finer than the network's pixels
        augmentation   the network's answers to turned and mirrored pictures, made one
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from polcap.images import Cues, Network, RunNetwork, SurfaceMaps
from polcap.stages import stage
from polcap.stages.infer import analytic, highlight_albedo, learned


class InferSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The section `infer` of a settings file."""

    ior: Annotated[float, Meta(ge=1.2, le=2.5, description="refractive index assumed by the analytic estimator")] = 1.5
    symmetries: Annotated[
        Literal[1, 2, 4, 8],
        Meta(description="turned and mirrored positions in which the network sees the object; answers are joined"),
    ] = 4
    fine: Annotated[bool, Meta(description="a second network adds relief that the first is shown too small to see")] = (
        True
    )


@stage(version=17)
def estimate(cues: Cues, network: Network | None, run: RunNetwork, settings: InferSettings) -> SurfaceMaps:
    """Normal, diffuse, specular, roughness and expected error; network None means analytic.

    Raises
    ------
    ModelError
        The network was made for other channels.
    """
    if network is None:
        maps = analytic.estimate(cues, settings.ior)
    else:
        maps = learned.estimate(cues, network, run, settings.ior, settings.symmetries, fine_pass=settings.fine)
    return highlight_albedo.correct_highlights(maps, cues, settings.ior)
