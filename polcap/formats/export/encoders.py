"""In: a picture of 8 or 16 bits. Out: the bytes of a PNG, JPEG, WebP or KTX2.

Data (normals, roughness, packed channels) is kept without loss wherever the kind can; colours are
compressed as their kind usually is. KTX2 needs one of Khronos' encoders (`ktx`, `toktx`) on the PATH.
"""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import SettingError, StorageError
from polcap.formats.export.texture_set import Pixels, Texture
from polcap.formats.maps import png

Kind = Literal["png", "jpeg", "webp", "ktx2"]
MIME: dict[Kind, str] = {"png": "image/png", "jpeg": "image/jpeg", "webp": "image/webp", "ktx2": "image/ktx2"}
_PROGRAMS = ("ktx", "toktx")
_QUALITY = {"jpeg": (95, 92), "webp": (101, 90)}  # data, colour; WebP over 100 is lossless


class Encoder:
    """Encodes each picture once, whichever files of an export hold it and in whichever threads they are written."""

    def __init__(self) -> None:
        self._lock = Lock()
        # the pixels stay with their bytes: no other array can then have their id
        self._made: dict[tuple[int, Kind, bool], tuple[Pixels, Future[bytes]]] = {}

    def __call__(self, texture: Texture, kind: Kind, *, text: bool = False) -> bytes:
        """As `encode`."""
        key = (id(texture.pixels), kind, texture.color)
        with self._lock:
            first = key not in self._made
            _, made = self._made.setdefault(key, (texture.pixels, Future()))
        if first:
            try:
                made.set_result(encode(texture, kind))
            except BaseException as error:
                made.set_exception(error)
        data = made.result()
        return png.described(data, {"Description": texture.says}) if text and kind == "png" else data

    def all(self, textures: Mapping[str, Texture], kind: Kind) -> dict[str, bytes]:
        """The bytes of each picture, in threads; the same whatever their number.

        Raises
        ------
        SettingError
            KTX2 was asked for and no encoder is on the PATH.
        """
        with ThreadPoolExecutor(min(len(textures), os.cpu_count() or 1) or 1) as pool:
            return dict(zip(textures, pool.map(partial(self, kind=kind), textures.values())))


def encode(texture: Texture, kind: Kind, *, text: bool = False) -> bytes:
    """The bytes of one picture; JPEG and WebP hold 8 bits, PNG what it is given.

    Parameters
    ----------
    texture
        The picture and what it means.
    kind
        Of the file.
    text
        Write into a PNG what it holds (a tEXt chunk), for files that lie beside the asset.

    Raises
    ------
    SettingError
        The kind cannot hold the picture's channels, or its encoder is not installed.
    StorageError
        The encoder failed.
    """
    if kind == "png":
        plain = png.encode(texture.pixels)
        return png.described(plain, {"Description": texture.says}) if text else plain
    if kind == "ktx2":
        return _ktx2(texture)
    quality = _QUALITY[kind][texture.color]
    pixels = png.swapped(_eight_bits(texture))
    if kind == "jpeg":
        if pixels.shape[-1] == 4:
            raise SettingError(f"{texture.says}: JPEG holds no fourth channel; choose png or webp")
        options = [cv2.IMWRITE_JPEG_QUALITY, quality]
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    else:
        options = [cv2.IMWRITE_WEBP_QUALITY, quality]
    done, coded = cv2.imencode(f".{kind}", pixels, options)
    if not done:
        raise StorageError(f"cannot encode a picture of {pixels.shape} as {kind}; choose png")
    return bytes(coded.tobytes())


def ktx2_encoder() -> str | None:
    """`ktx` or `toktx` of Khronos' KTX software, where it is installed."""
    return next((found for name in _PROGRAMS if (found := shutil.which(name))), None)


def _ktx2(texture: Texture) -> bytes:
    """UASTC with mipmaps, which keeps normals; its transfer function as the texture says."""
    program = ktx2_encoder()
    if program is None:
        raise SettingError("KTX2 needs `ktx` or `toktx` of Khronos' KTX software on the PATH; choose webp or png")
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "picture.png", Path(folder) / "picture.ktx2"
        source.write_bytes(png.encode(_eight_bits(texture)))
        done = subprocess.run([program, *_ktx2_options(program, texture, source, target)], capture_output=True)
        if done.returncode or not target.exists():
            said = " ".join(done.stderr.decode(errors="replace").split())
            raise SettingError(f"{Path(program).name} failed ({said[:200]}); choose webp or png")
        return target.read_bytes()


def _ktx2_options(program: str, texture: Texture, source: Path, target: Path) -> list[str]:
    transfer = "srgb" if texture.color else "linear"
    if Path(program).name == "toktx":
        options = ["--t2", "--encode", "uastc", "--genmipmap", "--threads", "1", "--assign_oetf", transfer]
        return [*options, str(target), str(source)]
    channels = "R8G8B8A8" if texture.pixels.shape[-1] == 4 else "R8G8B8"
    pixel = f"{channels}_{'SRGB' if texture.color else 'UNORM'}"
    options = ["create", "--format", pixel, "--assign-tf", transfer, "--encode", "uastc", "--threads", "1"]
    return [*options, "--generate-mipmap", str(source), str(target)]


def _eight_bits(texture: Texture) -> NDArray[np.uint8]:
    if texture.pixels.dtype == np.uint8:
        return np.asarray(texture.pixels, dtype=np.uint8)
    return np.asarray(np.rint(texture.pixels / 257.0), dtype=np.uint8)
