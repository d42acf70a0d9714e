"""The layered EXR of the small capture's result, read back and held against the maps."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from polcap.errors import SettingError
from polcap.formats.export import exr_layers
from polcap.formats.maps import exr

# Linear Rec.709 → ACEScg: primaries of S-2014-004, whites adapted by Bradford
REC709_TO_ACESCG = np.array(
    [[0.613097, 0.339523, 0.047379], [0.070194, 0.916354, 0.013452], [0.020616, 0.109570, 0.869815]]
)


def spec(file: Path) -> Any:
    return oiio.ImageBuf(str(file)).spec()


def test_layers_hold_the_maps_and_the_stokes_images(result: Path, tmp_path: Path) -> None:
    exr_layers.write(tmp_path / "all.exr", result / "maps", "lin_rec709", {"unit": "m"})
    layers, header = exr.read(tmp_path / "all.exr"), spec(tmp_path / "all.exr")
    assert {f"S{s}.{c}" for s in range(3) for c in "RGB"} | {"normal.x", "depth.Z", "mask.Y", "aolp.Y"} <= set(layers)
    for layer, file, channel in (("depth.Z", "depth", "Z"), ("normal.y", "normal", "G"), ("S1.G", "stokes", "S1.G")):
        assert np.array_equal(layers[layer], exr.read(result / "maps" / f"{file}.exr")[channel])
    assert header["colorInteropID"] == "lin_rec709_scene" and header["polcap:unit"] == "m"
    assert np.allclose(header["chromaticities"][:2], (0.64, 0.33))


def test_colours_go_to_acescg_and_data_stays(result: Path, tmp_path: Path) -> None:
    exr_layers.write(tmp_path / "aces.exr", result / "maps", "ACEScg", {})
    layers, header = exr.read(tmp_path / "aces.exr"), spec(tmp_path / "aces.exr")
    source = exr.read(result / "maps" / "diffuse.exr")
    rgb = np.stack([source[c] for c in "RGB"], axis=-1)
    found = np.stack([layers[f"diffuse.{c}"] for c in "RGB"], axis=-1)
    assert np.allclose(found, rgb @ REC709_TO_ACESCG.T, atol=2e-3)  # half
    assert np.array_equal(layers["roughness.Y"], exr.read(result / "maps" / "roughness.exr")["Y"])
    assert header["colorInteropID"] == "lin_ap1_scene"
    assert np.allclose(header["chromaticities"][:2], (0.713, 0.293))  # AP1 red


def test_role_finds_its_space_and_a_wrong_name_is_refused() -> None:
    assert exr_layers.find_space("scene_linear").name == "ACEScg"
    for wrong in ("ACEScq", "data"):
        with pytest.raises(SettingError, match="ACEScg"):
            exr_layers.find_space(wrong)
