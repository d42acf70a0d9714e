"""polcap: turns flash photographs taken through a rotating polarizer into a relightable 3-D asset.

The Python form of `polcap process`::

    import polcap

    result = polcap.process("CAPTURE")                  # the folder's photographs -> maps, asset, report
    maps = polcap.read_maps(result.folder)              # maps.normal, maps.diffuse, …, maps.depth

Names are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polcap.api import Result, check, export, fuse, process
    from polcap.capture_values import Capture, Frame, Shot
    from polcap.chart_values import ChartRequest
    from polcap.config import Config
    from polcap.config import load as load_config
    from polcap.errors import PolcapError
    from polcap.formats.capture.reader import read as read_capture
    from polcap.formats.maps.maps_folder import ResultMaps
    from polcap.formats.maps.result_maps import read as read_maps
    from polcap.formats.maps.result_maps import read_cues, read_stokes, read_stokes_covariance
    from polcap.image_values import View
    from polcap.mesh_values import Asset, Mesh
    from polcap.stage_values import Cues, StokesImage, SurfaceMaps

__version__ = "0.1.0"
__all__ = [
    "Asset", "Capture", "ChartRequest", "Config", "Cues", "Frame", "Mesh", "PolcapError", "Result", "ResultMaps",
    "Shot", "StokesImage", "SurfaceMaps", "View", "check", "export", "fuse", "load_config", "process", "read_capture",
    "read_cues", "read_maps", "read_stokes", "read_stokes_covariance",
]  # fmt: skip
_HOME = {  # public name → module and its name there
    **{name: ("polcap.api", name) for name in ("process", "check", "export", "fuse", "Result")},
    "Config": ("polcap.config", "Config"),
    "load_config": ("polcap.config", "load"),
    "PolcapError": ("polcap.errors", "PolcapError"),
    "read_capture": ("polcap.formats.capture.reader", "read"),
    "ResultMaps": ("polcap.formats.maps.maps_folder", "ResultMaps"),
    "read_cues": ("polcap.formats.maps.result_maps", "read_cues"),
    "read_maps": ("polcap.formats.maps.result_maps", "read"),
    "read_stokes": ("polcap.formats.maps.result_maps", "read_stokes"),
    "read_stokes_covariance": ("polcap.formats.maps.result_maps", "read_stokes_covariance"),
    **{name: ("polcap.capture_values", name) for name in ("Capture", "Frame", "Shot")},
    "ChartRequest": ("polcap.chart_values", "ChartRequest"),
    "View": ("polcap.image_values", "View"),
    **{name: ("polcap.mesh_values", name) for name in ("Asset", "Mesh")},
    **{name: ("polcap.stage_values", name) for name in ("Cues", "StokesImage", "SurfaceMaps")},
}


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in __all__:
        raise AttributeError(f"module 'polcap' has no attribute {name!r}")
    module, attribute = _HOME[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
