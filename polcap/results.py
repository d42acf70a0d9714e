"""Results of the path for one capture; their fields list its stages, in order. The last stage is the asset."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:  # the command line needs the names of the stages before the values are imported
    from collections.abc import Mapping

    from polcap.chart_values import ColorCalibration
    from polcap.mesh_values import ReliefMesh
    from polcap.stage_values import Alignment, AngleStack, Cues, ObjectMask, SelfCalibration, StokesImage, SurfaceMaps


@dataclass(frozen=True)
class Results:
    """One value per stage, and the cache keys; after an early stop only the first stages have values."""

    radiance: AngleStack = field(metadata={"stage": "hdr"})  # RAW brackets -> radiance, variance, quality
    color: ColorCalibration = field(metadata={"stage": "whitebalance"})  # ColorChecker -> color matrix
    alignment: Alignment = field(metadata={"stage": "align"})  # radiance -> one transform per shot
    object_: ObjectMask = field(metadata={"stage": "mask"})  # radiance -> the object's pixels
    selfcal: SelfCalibration = field(metadata={"stage": "selfcal"})  # gains of the shots, order of the angles
    stokes: StokesImage = field(metadata={"stage": "stokes"})  # gains and transforms applied -> S0, S1, S2 of the crop
    cues: Cues = field(metadata={"stage": "cues"})  # Stokes, color matrix -> DoLP, diffuse color, network channels
    maps: SurfaceMaps = field(metadata={"stage": "infer"})  # cues -> normal, diffuse, specular, roughness, error
    mesh: ReliefMesh = field(metadata={"stage": "surface"})  # normals -> depth and mesh
    keys: Mapping[str, str]  # cache key of each stage that ran, by stage

    @classmethod
    def partial(cls, **made: Any) -> Self:
        """Results of some stages only, without the attributes of the others."""
        found = object.__new__(cls)
        vars(found).update(made)
        return found


FIELDS = {one.metadata["stage"]: one.name for one in fields(Results) if "stage" in one.metadata}  # by stage
STAGES = (*FIELDS, "asset")  # maps/ and mesh -> glTF textures and factors: `pipeline/asset_export.py`
