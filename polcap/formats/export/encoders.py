"""Encodes textures as PNG, JPEG, WebP or KTX2, and animations as WebP or MP4.

Data (normals, roughness, packed channels) is lossless where the kind allows it; colors are compressed as usual for
their kind. KTX2 needs one of Khronos' encoders (`ktx`, `toktx`) on the PATH, MP4 needs FFmpeg.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.errors import SettingError, StorageError
from polcap.formats import atomic
from polcap.formats.export.texture_set import Texture
from polcap.formats.maps import png
from polcap.image_values import TexturePixels

Kind = Literal["png", "jpeg", "webp", "ktx2"]
MIME: dict[Kind, str] = {"png": "image/png", "jpeg": "image/jpeg", "webp": "image/webp", "ktx2": "image/ktx2"}
Frames = list[NDArray[np.uint8]]
_ANIMATION_QUALITY = 95  # with 80, blocks that change slowly stay as they were for several frames
_KTX2 = {  # options of each encoder: UASTC with mipmaps, which preserves normals
    "ktx": "create --format {pixel} --assign-tf {transfer} --encode uastc --threads 1 "
    "--generate-mipmap {source} {target}",
    "toktx": "--t2 --encode uastc --genmipmap --threads 1 --assign_oetf {transfer} {target} {source}",
}
_QUALITY = {"jpeg": (95, 92), "webp": (101, 90)}  # data, color; WebP over 100 is lossless


class TextureEncoder:
    """Encodes each texture of an export once, even if several files contain it; safe with threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        # holds the pixels too, so that no other array can get their id
        self._made: dict[tuple[int, Kind, bool], tuple[TexturePixels, Future[bytes]]] = {}

    def __call__(self, texture: Texture, kind: Kind) -> bytes:
        """The bytes of one texture as for `encode`."""
        key = (id(texture.pixels), kind, texture.color)
        with self._lock:
            first = key not in self._made
            _, made = self._made.setdefault(key, (texture.pixels, Future()))
        if first:
            try:
                made.set_result(encode(texture, kind))
            except BaseException as error:
                made.set_exception(error)
        return made.result()

    def all(self, textures: Mapping[str, Texture], kind: Kind) -> dict[str, bytes]:
        """Encode several textures on threads; returns bytes by texture name. Raises SettingError as `encode` does."""
        return dict(zip(textures, parallel.results(partial(self, texture, kind) for texture in textures.values())))


def encode(texture: Texture, kind: Kind) -> bytes:
    """Encode one texture as PNG (8 or 16 bits per channel, as the texture), JPEG, WebP or KTX2 (8 bits).

    Raises SettingError: JPEG for four channels, or no working KTX2 encoder. StorageError: OpenCV cannot encode it.
    """
    if kind == "png":
        return png.encode(texture.pixels, texture.color)
    if kind == "ktx2":
        return _ktx2(texture)
    quality = _QUALITY[kind][texture.color]
    pixels = png.swapped(eight_bits(texture))
    if kind == "jpeg":
        if pixels.shape[-1] == 4:
            raise SettingError(f"{texture.meaning}: JPEG holds no fourth channel; choose png or webp")
        options = [cv2.IMWRITE_JPEG_QUALITY, quality]
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    else:
        options = [cv2.IMWRITE_WEBP_QUALITY, quality]
    done, coded = cv2.imencode(f".{kind}", pixels, options)
    if not done:
        raise StorageError(f"cannot encode a picture of {pixels.shape} as {kind}; choose png")
    return bytes(coded.tobytes())


def ktx2_encoder() -> str | None:
    """Path of an installed KTX2 encoder (Khronos' `ktx` or `toktx`), or None."""
    return next((found for name in _KTX2 if (found := shutil.which(name))), None)


def _ktx2(texture: Texture) -> bytes:
    """Encode a texture as KTX2 by an installed program. Raises SettingError: there is none, or it fails."""
    program = ktx2_encoder()
    if program is None:
        raise SettingError("KTX2 needs `ktx` or `toktx` of Khronos' KTX software on the PATH; choose webp or png")
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "picture.png", Path(folder) / "picture.ktx2"
        source.write_bytes(png.encode(eight_bits(texture)))
        values = {
            "pixel": "R8G8B8" + "A8" * (texture.pixels.shape[-1] == 4) + ("_SRGB" if texture.color else "_UNORM"),
            "transfer": "srgb" if texture.color else "linear",
            "source": source,
            "target": target,
        }
        options = [word.format(**values) for word in _KTX2[Path(program).stem].split()]
        done = subprocess.run([program, *options], capture_output=True)
        if done.returncode or not target.exists():
            reason = " ".join(done.stderr.decode(errors="replace").split())
            raise SettingError(f"{Path(program).name} failed ({reason[:200]}); choose webp or png")
        return target.read_bytes()


def eight_bits(texture: Texture) -> NDArray[np.uint8]:
    """The pixels of a texture, (H, W) or (H, W, C), as integers of 8 bits."""
    if texture.pixels.dtype == np.uint8:
        return np.asarray(texture.pixels, dtype=np.uint8)
    return np.asarray(np.rint(texture.pixels / 257.0), dtype=np.uint8)  # 65535 / 255


def animate(path: Path, frames: Frames, seconds: float) -> list[Path]:
    """Write sRGB frames (H, W, 3) as path.webp, which repeats, and with FFmpeg as path.mp4; returns the files.

    Both last `seconds`. Raises StorageError: OpenCV was built without WebP, or FFmpeg fails.
    """
    files = [path.with_suffix(".webp")]
    moving = cv2.Animation()
    moving.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in frames]
    moving.durations = [round(1000 * seconds / len(frames))] * len(frames)
    done, data = cv2.imencodeanimation(".webp", moving, [cv2.IMWRITE_WEBP_QUALITY, _ANIMATION_QUALITY])
    if not done:
        raise StorageError(f"{files[0]}: this OpenCV writes no WebP; install opencv-contrib-python-headless from PyPI")
    atomic.write(files[0], data.tobytes())
    if program := shutil.which("ffmpeg"):
        files.append(path.with_suffix(".mp4"))
        _write_mp4(program, files[1], frames, seconds)
    return files


def _write_mp4(program: str, path: Path, frames: Frames, seconds: float) -> None:
    """Write 8-bit sRGB frames (H, W, 3) as an MP4 video (H.264) by FFmpeg."""
    height, width = (edge - edge % 2 for edge in frames[0].shape[:2])  # H.264 stores colors at half size
    command = [
        program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", f"{len(frames) / seconds:.4f}", "-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18",
        "-f", "mp4",
    ]  # fmt: skip
    content = b"".join(np.ascontiguousarray(frame[:height, :width]).tobytes() for frame in frames)
    with atomic.path(path) as temporary:
        done = subprocess.run([*command, str(temporary)], input=content, capture_output=True)
        if done.returncode:
            raise StorageError(f"{path}: ffmpeg failed: {done.stderr.decode(errors='replace').strip()[-200:]}")
