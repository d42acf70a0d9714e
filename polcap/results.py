"""The results of all stages for one capture: plain values, arrays as read-only memory maps."""

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
    """A stage did not run, because the path stopped before it."""


@dataclass(frozen=True)
class Results:
    """One value per stage. A path that was stopped early has only the first of them."""

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
    keys: Mapping[str, str]  # cache key of each stage that has run, by stage

    @classmethod
    def partial(cls, **made: Any) -> Self:
        """The results that exist; any other raises NotReached when it is used."""
        found = object.__new__(cls)
        vars(found).update(made)
        return found

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            raise NotReached(f"the path stopped before {name}")
