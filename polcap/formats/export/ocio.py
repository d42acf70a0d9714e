"""In: linear Rec.709 colours. Out: the same in any colour space or role of an OpenColorIO configuration.

The configuration is $OCIO where that is set, else the one built into OpenImageIO (ACES' CG config).
Spaces are found by role, name or alias: their names differ between configurations.
"""

import os
from dataclasses import dataclass

import numpy as np

from polcap.errors import SettingError
from polcap.images import Floats

INSIDE = "lin_rec709"  # as OpenColorIO's configurations alias linear Rec.709


@dataclass(frozen=True)
class Space:
    """A colour space as found."""

    name: str
    interop_id: str | None  # Color Interop Forum's name, where the configuration tells it
    chromaticities: tuple[float, ...] | None  # (8,) xy of R, G, B and white
    linear: bool


def find(wanted: str) -> Space:
    """The colour space behind a role, name or alias.

    Raises
    ------
    SettingError
        The configuration has no such space, or it is data or a display.
    """
    import OpenImageIO as oiio

    source = _source()
    config = oiio.ColorConfig(source)
    if config.geterror() or not config.getColorSpaceNames():
        raise SettingError(f"$OCIO {source} cannot be read as an OpenColorIO configuration; correct or unset it")
    name = config.resolve(wanted)
    if name not in config.getColorSpaceNames() or config.isData(name):
        known = ", ".join(sorted([*config.getRoles(), *config.getColorSpaceNames()]))
        raise SettingError(f"--color {wanted} is no colour space or role of {source}; it has {known}")
    white = config.get_chromaticities(name)
    return Space(
        name=name,
        interop_id=config.get_color_interop_id(name) or None,
        chromaticities=tuple(float(x) for x in white) if white else None,
        linear=bool(config.isColorSpaceLinear(name)),
    )


def convert(rgb: Floats, space: Space) -> Floats:
    """Linear Rec.709 (H, W, 3) → the space.

    Raises
    ------
    SettingError
        The configuration knows no way from linear Rec.709.
    """
    import OpenImageIO as oiio

    source = oiio.ImageBuf(np.ascontiguousarray(rgb, dtype=np.float32))
    done = oiio.ImageBufAlgo.colorconvert(source, INSIDE, space.name, colorconfig=_source())
    if done.has_error:
        said = " ".join(done.geterror().split())
        raise SettingError(f"no way from linear Rec.709 to {space.name} ({said}); choose another --color or $OCIO")
    return np.asarray(done.get_pixels(oiio.FLOAT), dtype=np.float32)


def _source() -> str:
    return os.environ.get("OCIO") or "ocio://default"
