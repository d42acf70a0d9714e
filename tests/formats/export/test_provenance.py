"""The provenance record of an asset names its photographs by their digests."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from polcap import report
from polcap.formats.capture import reader as capture
from polcap.formats.export import provenance
from polcap.formats.maps import png

NOTHING = {"versions": {}, "polcap": "", "model": None, "settings": {}, "keys": {}, "verdict": "warn"}


@pytest.mark.parametrize("how", ['name = "bowl"\n', 'encoding = "linear"\nwhite = 4095\nblack = 64\n'])
def test_photographs_have_their_sha256_and_the_catalog_entry_is_taken_over(tmp_path: Path, how: str) -> None:
    for angle in (0, 60, 120):
        picture = np.random.default_rng(angle).integers(100, 4000, (48, 64, 3)).astype(np.uint16)
        (tmp_path / f"pol{angle:03}").mkdir()
        png.write(tmp_path / f"pol{angle:03}" / "bowl.png", picture)
    (tmp_path / "capture.toml").write_text(how + '[catalog]\ntitle = "Bowl"\nrights = "©"\n', encoding="utf-8")
    facts = report.capture_facts(capture.read(tmp_path))
    record = provenance.record({"capture": facts, **NOTHING, "expected_error_deg": 3.1}, {"rights": "CC0"})
    assert (record["verdict"], provenance.words(record)["expected_error_deg"]) == ("warn", "3.1")
    assert "expected_error_deg" not in provenance.record({"capture": facts, **NOTHING})  # not measured
    assert (record["title"], record["rights"], record.get("creator")) == ("Bowl", "CC0", None)
    assert [one["angle_deg"] for one in record["photographs"]] == [0, 60, 120]  # not 59.99999999999999
    for one in record["photographs"]:
        assert one["sha256"] == hashlib.sha256((tmp_path / one["file"]).read_bytes()).hexdigest()
