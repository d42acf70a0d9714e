"""The stages: pure functions from values of `images.py` to values of `images.py`.

In the order a pixel meets them:

    hdr            RAW bracket of each angle -> radiance, variance, quality
    whitebalance   ColorChecker -> colour matrix
    align          radiance -> one transform per angle
    mask           which pixels are the object
    selfcal        gains per shot, order and handedness of the angles
    stokes         radiance, gains, transforms -> S0, S1, S2 of the crop
    cues           Stokes, matrix -> DoLP, normalised Stokes map, diffuse colour, network channels
    infer          cues -> normal, diffuse, specular, roughness, confidence
    surface        normals -> depth and mesh
    asset          maps and mesh -> what a renderer wants

A stage opens no file, warns of nothing and skips nothing: it returns a new value or raises.
Stages do not import each other. What two of them share lives in `optics/`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Stage(Generic[P, T]):
    """A pure function with a name and a version that is raised whenever its pixels change."""

    function: Callable[P, T]
    version: int
    keep: bool  # False: cheaper to compute again than to store

    @property
    def name(self) -> str:
        return self.function.__module__.rpartition(".")[2]

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        """As the function itself."""
        return self.function(*args, **kwargs)


def stage(*, version: int, keep: bool = True) -> Callable[[Callable[P, T]], Stage[P, T]]:
    """Mark the one public function of a stage's module."""
    return lambda function: Stage(function, version, keep)
