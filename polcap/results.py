"""Results of all stages for one capture."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from polcap.images import (
    Alignment,
    AngleStack,
    Asset,
    ColorCalibration,
    Cues,
    Mesh,
    ObjectMask,
    SelfCalibration,
    StokesImage,
    SurfaceMaps,
)


class NotReached(AttributeError):
    """Error: the code asked for the result of a stage that did not run."""


@dataclass(frozen=True)
class Results:
    """One value per stage, and the cache keys; after an early stop only the first stages have values."""

    radiance: AngleStack
    color: ColorCalibration
    alignment: Alignment
    object_: ObjectMask
    selfcal: SelfCalibration
    stokes: StokesImage
    cues: Cues
    maps: SurfaceMaps
    mesh: Mesh
    asset: Asset
    keys: Mapping[str, str]  # cache key of each stage that ran, by stage

    @classmethod
    def partial(cls, **made: Any) -> Self:
        """Results of some stages only; access to the result of any other stage raises NotReached."""
        found = object.__new__(cls)
        vars(found).update(made)
        return found

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            raise NotReached(f"the path stopped before {name}")
