"""Results of the path for one capture, one class per stage after which a path may end. The last stage is the asset."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # the command line needs the names of the stages before the values are imported
    from collections.abc import Mapping

    from polcap.chart_values import ColorCalibration
    from polcap.mesh_values import ReliefMesh
    from polcap.stage_values import Alignment, AngleStack, Cues, ObjectMask, SelfCalibration, StokesImage, SurfaceMaps


@dataclass(frozen=True, kw_only=True)
class FirstResults:
    """Results of the first stages; each class below adds the result of the next stage."""

    keys: Mapping[str, str]  # cache key of each stage that ran, by stage


@dataclass(frozen=True, kw_only=True)
class ResultsUntilHdr(FirstResults):
    """RAW brackets -> radiance, variance, quality."""

    radiance: AngleStack = field(metadata={"stage": "hdr"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilWhitebalance(ResultsUntilHdr):
    """ColorChecker -> color matrix."""

    color: ColorCalibration = field(metadata={"stage": "whitebalance"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilAlign(ResultsUntilWhitebalance):
    """Radiance -> one transform per shot."""

    alignment: Alignment = field(metadata={"stage": "align"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilMask(ResultsUntilAlign):
    """Radiance -> the object's pixels."""

    object_: ObjectMask = field(metadata={"stage": "mask"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilSelfcal(ResultsUntilMask):
    """Light of the object -> gains of the shots, order of the angles."""

    selfcal: SelfCalibration = field(metadata={"stage": "selfcal"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilStokes(ResultsUntilSelfcal):
    """Gains and transforms applied -> S0, S1, S2 of the crop."""

    stokes: StokesImage = field(metadata={"stage": "stokes"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilCues(ResultsUntilStokes):
    """Stokes, color matrix -> DoLP, diffuse color, network channels."""

    cues: Cues = field(metadata={"stage": "cues"})


@dataclass(frozen=True, kw_only=True)
class ResultsUntilInfer(ResultsUntilCues):
    """Cues -> normal, diffuse, specular, roughness, error."""

    maps: SurfaceMaps = field(metadata={"stage": "infer"})


@dataclass(frozen=True, kw_only=True)
class Results(ResultsUntilInfer):
    """Normals -> depth and mesh; with it, the path is complete."""

    mesh: ReliefMesh = field(metadata={"stage": "surface"})


R = TypeVar("R", bound=FirstResults)
FIELDS: dict[str, str] = {one.metadata["stage"]: one.name for one in fields(Results) if one.metadata}  # by stage
STAGES = (*FIELDS, "asset")  # maps/ and mesh -> glTF textures and factors: `pipeline/asset_export.py`
_KINDS: tuple[type[FirstResults], ...] = Results.__mro__[-2::-1]  # by number of stages: FirstResults first


def collect(values: Mapping[str, Any], keys: Mapping[str, str]) -> FirstResults:
    """The results of the first stages, from their values and cache keys by stage."""
    return _KINDS[len(values)](keys=keys, **{FIELDS[stage]: value for stage, value in values.items()})


def last_stage(kind: type[FirstResults]) -> str:
    """The last stage of a class of results."""
    return STAGES[_KINDS.index(kind) - 1]


def kind_until(stage: str) -> type[FirstResults]:
    """The class of the results until a stage; for the asset, that of the whole path."""
    return _KINDS[min(STAGES.index(stage) + 1, len(FIELDS))]
