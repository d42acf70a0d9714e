"""Settings: defaults < file < assignments, and strict."""

from pathlib import Path

import msgspec
import pytest

from polcap.config import Config, fill, load, read, settings
from polcap.errors import SettingError
from polcap.fusion.fusion_path import SessionConfig
from polcap.synth.shooting import Shoot


def test_defaults_come_from_the_stages() -> None:
    assert load() == Config()


def test_assignment_beats_file_beats_default(tmp_path: Path) -> None:
    file = tmp_path / "polcap.toml"
    file.write_text("[hdr]\nclip = 0.9\n[align]\nmax_shift_px = 12\n")
    config = load(file, ["hdr.clip=0.95"])
    assert (config.hdr.clip, config.align.max_shift_px) == (0.95, 12.0)
    assert config.mask == Config().mask


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("hdr.clip=1.5", ["hdr.clip", "1.5", "1.0"]),
        ("hdr.clib=0.9", ["hdr.clib", "0.9", "did you mean hdr.clip"]),
        ("hrd.clip=0.9", ["hrd.clip", "no such setting"]),
        ("hdr.clip=much", ["hdr.clip", "much", "float"]),
        ("align.model=affine", ["align.model", "affine"]),
        ("hdr.clip", ["hdr.clip=VALUE"]),
        ("clip=0.9", ["did you mean hdr.clip"]),
    ],
)
def test_wrong_assignment_is_named_with_value_and_limit(assignment: str, words: list[str]) -> None:
    with pytest.raises(SettingError) as caught:
        load(None, [assignment])
    assert all(word in str(caught.value) for word in words) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("infer.symmetries=3", "not one of 1, 2, 4, 8"),
        ("[hdr]\nclip = 2", "hdr.clip = 2"),
        ("clip = 0.9", "did you mean hdr.clip"),
        ("[hdr", "not TOML"),
        ("[colour]\nx = 1", "colour.x"),
        ("[hdr]\nclip = '0.9'", "hdr.clip"),
        (None, "--config"),
    ],
)
def test_wrong_or_missing_file_is_one_line(tmp_path: Path, text: str | None, words: str) -> None:
    file = tmp_path / "polcap.toml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(SettingError, match=words) as caught:
        load(file)
    assert "\n" not in str(caught.value)


def test_every_setting_is_described() -> None:
    assert [setting.key for setting in settings(SessionConfig) if not setting.description] == []


def test_settings_of_the_fusion_are_a_section_with_sections(tmp_path: Path) -> None:
    file = tmp_path / "polcap.toml"
    file.write_text("[hdr]\nclip = 0.9\n[fusion.atlas]\nsize = 2048\nmargin = 8\n")
    config = fill(SessionConfig, read(file), ["fusion.atlas.size=1024"])
    assert (config.fusion.atlas.size, config.fusion.atlas.margin, config.hdr.clip) == (1024, 8, 0.9)
    assert config.of_views == load(None, ["hdr.clip=0.9"])
    for wrong, words in (("atlas.sice=1", "did you mean fusion.atlas.size"), ("atlas.size=9000", "≤ 8192|<= 8192")):
        with pytest.raises(SettingError, match=words):
            fill(SessionConfig, {}, [f"fusion.{wrong}"])
    with pytest.raises(SettingError, match=r"fusion\.atlas\.size = 2048: there is no such setting"):
        load(file)


def test_config_survives_its_own_dump() -> None:
    config = load(None, ["hdr.clip=0.95"])
    assert msgspec.convert(msgspec.to_builtins(config), Config) == config


@pytest.mark.parametrize("text", ["0,60,120", "[0,60,120]", "0, 60, 120"])
def test_a_list_may_be_typed_without_brackets(text: str) -> None:
    assert fill(Shoot, {}, [f"angles_deg={text}"]).angles_deg == (0, 60, 120)


def test_words_need_no_quotes_and_numbers_no_leading_zero() -> None:
    config = load(None, ["align.model=homography", "gates.max_mask_doubt=.3"])
    assert (config.align.model, config.gates.max_mask_doubt) == ("homography", 0.3)
    assert fill(Shoot, {}, ["angles_deg=[.5, 45, 90.5]"]).angles_deg == (0.5, 45, 90.5)
