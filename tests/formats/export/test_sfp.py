"""The folder for codes of shape from polarization gives the same polarization by another code's own equations."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import loadmat

from polcap.formats.export import sfp
from polcap.formats.maps import result_maps
from tests.conftest import Command


def polarisation_image(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """DoLP, phase 0…π and unpolarized light of a MAT-file by the linear method of Smith et al. (ECCV 2016).

    Each row of `angles` belongs to a picture of `images` (H, W, N); `mask` selects pixels, so it must be logical.
    """
    held = loadmat(file)
    images, angles, mask = held["images"], held["angles"].ravel(), held["mask"].view(bool)
    light = np.stack([images[:, :, k][mask] for k in range(images.shape[2])])
    columns = np.stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)], axis=1)
    middle, cosine, sine = np.linalg.lstsq(columns, light, rcond=None)[0]
    most, least = middle + np.hypot(cosine, sine), middle - np.hypot(cosine, sine)
    return (most - least) / (most + least), (np.arctan2(sine, cosine) / 2) % np.pi, (most + least) / 2


@pytest.fixture(scope="module")
def folder(result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("sfp")
    sfp.write(place, result / "maps")
    return place


def test_another_code_reads_the_same_polarization(result: Path, folder: Path) -> None:
    dolp, phase, light = polarisation_image(folder / "sfp.mat")
    s0, s1, s2 = result_maps.read_stokes(result).astype(float).mean(axis=-1)[:, result_maps.read(result).mask]
    np.testing.assert_allclose(light, s0 / 2, rtol=1e-6)
    np.testing.assert_allclose(dolp, np.hypot(s1, s2) / s0, atol=1e-6)
    np.testing.assert_allclose(np.exp(2j * phase), (s1 + 1j * s2) / np.hypot(s1, s2), atol=1e-5)


def test_mask_is_logical_and_angles_are_a_row(folder: Path) -> None:
    """MATLAB needs both: `im(mask)` selects pixels, and `angles'` is a column."""
    held = loadmat(folder / "sfp.mat", mat_dtype=True)
    assert held["mask"].dtype == bool and held["spec"].dtype == bool and not held["spec"].any()
    assert held["angles"].shape == (1, 4)
    assert held["normal"].shape == (*held["mask"].shape, 3) and held["K"].shape == (3, 3)


def test_pictures_follow_the_readme(result: Path, folder: Path) -> None:
    first, second, third, fourth = (
        cv2.imread(str(folder / f"pol{angle:03d}.png"), cv2.IMREAD_UNCHANGED).astype(float)
        for angle in (0, 45, 90, 135)
    )
    maps, text = result_maps.read(result), (folder / "README.txt").read_text(encoding="utf-8")
    assert text.count("\n") == 1
    lit = maps.mask & (np.min([first, second, third, fourth], axis=(0, -1)) > 0)  # noise below 0 is clipped
    np.testing.assert_allclose((first + third)[lit], (second + fourth)[lit], atol=2)  # both are S0
    normal = cv2.imread(str(folder / "normal.png"), cv2.IMREAD_UNCHANGED)[..., ::-1] / 32767.5 - 1
    np.testing.assert_allclose(normal[maps.mask], maps.normal[maps.mask], atol=3e-5)
    aolp = cv2.imread(str(folder / "aolp.png"), cv2.IMREAD_UNCHANGED) * np.pi / 65536
    difference = np.abs(np.exp(2j * aolp) - np.exp(2j * result_maps.read_cues(result)["aolp"]))
    assert difference[maps.mask].max() < 2e-4
    np.testing.assert_allclose(np.loadtxt(folder / "K.txt"), maps.view.intrinsic, atol=1e-5)


def test_the_same_result_gives_the_same_bytes(result: Path, folder: Path, tmp_path: Path) -> None:
    files = sfp.write(tmp_path, result / "maps")
    assert files and all(file.read_bytes() == (folder / file.name).read_bytes() for file in files)


def test_the_command_writes_the_folder(copy: Path, polcap: Command) -> None:
    done = polcap("export", copy, "--sfp")
    assert done.returncode == 0, done.stderr
    assert {"sfp.mat", "pol135.png", "K.txt", "README.txt"} <= {Path(line).name for line in done.stdout.splitlines()}
