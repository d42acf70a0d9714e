"""A texture of several files of an export is encoded once; animations show what their frames show."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from polcap.errors import SettingError
from polcap.formats.export import encoders
from polcap.formats.export.encoders import TextureEncoder
from polcap.formats.export.texture_set import Texture


def picture(channels: int = 3) -> Texture:
    return Texture(np.random.default_rng(2).integers(0, 255, (40, 30, channels), np.uint8), True, "a color")


def test_a_picture_is_encoded_once_for_several_files(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    whole = encoders.encode

    def counted(texture: Texture, kind: encoders.Kind) -> bytes:
        asked.append(kind)
        return whole(texture, kind)

    monkeypatch.setattr(encoders, "encode", counted)
    texture, encoder = picture(), TextureEncoder()
    with ThreadPoolExecutor(8) as pool:
        made = set(pool.map(lambda _: encoder(texture, "png"), range(16)))
    assert made == {whole(texture, "png")}
    assert asked == ["png"]
    assert encoder(texture, "webp") == whole(texture, "webp")
    assert encoder(texture, "jpeg") != encoder(Texture(texture.pixels, False, "numbers"), "jpeg")


def test_a_texture_that_cannot_be_encoded_fails_each_time() -> None:
    texture, encoder = picture(4), TextureEncoder()
    for _ in range(2):
        with pytest.raises(SettingError, match="no fourth channel"):
            encoder(texture, "jpeg")


def test_an_animation_follows_slow_changes(tmp_path: Path) -> None:
    y, x = np.mgrid[:96, :96] / 96
    light = [0.2 + 0.5 * x * y + 0.012 * k + 0.02 * np.sin(9 * x + k / 3) for k in range(24)]
    frames = [np.repeat(np.rint(255 * one).astype(np.uint8)[..., None], 3, axis=-1) for one in light]
    file = encoders.animate(tmp_path / "light", frames, 2.0)[0]
    _, shown = cv2.imdecodeanimation(np.fromfile(file, np.uint8))
    drawn = [np.asarray(one)[..., :3].astype(int) for one in shown.frames]
    assert max(np.abs(one - frame).mean() for one, frame in zip(drawn, frames)) < 3  # of 255
