"""In: frames. Out: an animated WebP; an MP4 where FFmpeg is on the path."""

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import StorageError
from polcap.formats import atomic

Frames = list[NDArray[np.uint8]]
_QUALITY = 80


def webp(path: Path, frames: Frames, seconds: float) -> None:
    """Write frames (H, W, 3) sRGB that take `seconds` together, and begin again.

    Raises
    ------
    StorageError
        The file cannot be written, or OpenCV was built without WebP.
    """
    moving = cv2.Animation()
    moving.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in frames]
    moving.durations = [round(1000 * seconds / len(frames))] * len(frames)
    done, data = cv2.imencodeanimation(".webp", moving, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    if not done:
        raise StorageError(f"{path}: this OpenCV writes no WebP; install opencv-contrib-python-headless from PyPI")
    with atomic.path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def encoder() -> str | None:
    """Path of FFmpeg; None where there is none."""
    return shutil.which("ffmpeg")


def mp4(path: Path, frames: Frames, seconds: float) -> None:
    """Write the same as H.264 with FFmpeg.

    Raises
    ------
    StorageError
        FFmpeg is missing, or fails.
    """
    program = encoder()
    if program is None:
        raise StorageError(f"{path}: no ffmpeg on the path writes it; install FFmpeg")
    height, width = (edge - edge % 2 for edge in frames[0].shape[:2])  # H.264 halves colors
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
