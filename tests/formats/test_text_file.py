"""The message about a wrong setting names its key, its value and its limit."""

from typing import Any

import msgspec
import pytest

from polcap.formats.capture.capture_toml import CaptureFile
from polcap.formats.text_file import fault
from polcap.synth.shooting import Shoot


@pytest.mark.parametrize(
    ("data", "kind", "words"),
    [
        ({"focal_lenght_mm": 50}, CaptureFile, "focal_lenght_mm: there is no such key; did you mean focal_length_mm?"),
        ({"rotator": {"modle": ""}}, CaptureFile, "rotator.modle: there is no such key; did you mean model?"),
        ({"rotator": {"x": 1}}, CaptureFile, "rotator.x: there is no such key; there are model, log"),
        (
            {"frame": [{"file": "a", "angel": 0}]},
            CaptureFile,
            "frame[0].angel: there is no such key; did you mean angle?",
        ),
        ({"frame": [{"file": "a", "role": "sht"}]}, CaptureFile, "frame[0].role = 'sht': not one of ambient, "),
        ({"frame": [{"angle": 0}]}, CaptureFile, "frame[0]: object missing required field `file`"),
        ({"focal_length_mm": 0}, CaptureFile, "focal_length_mm = 0: expected `float` > 0.0"),
        ({"step": 0.5}, Shoot, "step = 0.5: expected `float` > 1.0"),
        ({"angles_deg": [0, "x"]}, Shoot, "angles_deg[1] = 'x': expected `float`, got `str`"),
        ({"distortion": [0, "x"]}, Shoot, "distortion[1] = 'x': expected `float`, got `str`"),
        (
            {"catalog": {"object_number": 7.5}},
            CaptureFile,
            "catalog.object_number = 7.5: is not text; put it in quotes",
        ),
        ({"angles_deg": []}, Shoot, "angles_deg: expected `array` of length >= 1"),
        ({"sensor": {"isoo": 100}}, Shoot, "sensor.isoo: there is no such key"),
    ],
)
def test_fault_names_key_value_and_limit(data: dict[str, Any], kind: type[msgspec.Struct], words: str) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(data, kind)
    assert fault(caught.value, data, kind).startswith(words)
