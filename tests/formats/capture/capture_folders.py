"""Small capture folders of DNGs and pictures, for the tests."""

from itertools import count

import numpy as np

from tests.formats import headers
from tests.formats.raw.test_photo import save

_serial = count()


def shoot(path, time=1 / 50, clock="00:00:00", model=b"Z1", lens=b"Macro 60", size=(32, 48), tags=None, **settings):
    """A small DNG of its own pixels; `tags` are more ones of its main directory."""
    path.parent.mkdir(parents=True, exist_ok=True)
    photo = headers.settings(time=time, **settings) | {36867: (2, f"2026:01:02 {clock}".encode()), 42036: (2, lens)}
    if clock is None:
        del photo[36867]
    pixels = np.random.default_rng(next(_serial)).integers(500, 4000, size)
    path.write_bytes(headers.dng(pixels, photo=photo, maker=headers.camera(model=model) | (tags or {})))
    return path


def each(root, folder_names, **settings):
    """A folder with a photograph in each of these folders."""
    for name in folder_names:
        shoot(root / name / "a.dng", **settings)
    return root


def state(root, angles, **facts):
    """A capture.toml with these `angles` by name of file and other facts."""
    lines = [f"{key} = {value}" for key, value in facts.items()]
    lines += [f'[[frame]]\nfile = "{name}"\nangle = {angle}' for name, angle in angles.items()]
    (root / "capture.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def folders(root, angles=("000", "045", "090"), times=(1 / 200, 1 / 50)):
    for angle in angles:
        for number, time in enumerate(reversed(times)):  # brightest first, to be sorted
            shoot(root / f"pol{angle}" / f"IMG_{number}.dng", time)
    return root


def flat(root, shots=3, times=(1 / 200, 1 / 50)):
    for number in range(shots * len(times)):
        name = f"IMG_{(number + 9998) % 10000:04d}.dng"  # the camera's counter starts again at 0
        shoot(root / name, times[number % len(times)], f"00:{number:02d}:00")
    return root


def pictures(root, names):
    root.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        save(root / name, np.full((8, 10, 3), 300 + number, np.uint16))
    return root


def degrees(understood):
    return np.degrees(understood.angle).round(6).tolist()


def names(shot):
    return [frame.path.rpartition("/")[2] for frame in shot.frames]
