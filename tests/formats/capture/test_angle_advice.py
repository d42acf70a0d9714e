"""Advice about wrong polarizer angles can be followed literally in every layout, and corrects them."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from polcap.capture_values import AngleStatement, ShotOrder
from polcap.formats.capture import angle_advice
from polcap.formats.capture import reader as capture
from polcap.formats.raw import frame_decoder
from tests.formats.capture.capture_folders import each, flat, folders, pictures, shoot, state
from tests.formats.raw.test_photo import mosaic, save

ORDERS = [ShotOrder((0, 2, 1)), ShotOrder((1, 2, 0)), ShotOrder((0, 1, 2), True), ShotOrder((2, 1, 0), True)]


def listed(root, **facts):
    """A capture.toml with the angle of each file."""
    angles = {shoot(root / f"IMG_{number}.dng").name: angle for number, angle in enumerate((0, 45, 90))}
    state(root, angles, **facts)
    return root


LAYOUTS = {
    "folders": folders,
    "numbered folders": lambda root: each(root, ("0 Grad", "45 Grad", "90 Grad")),
    "flat": flat,
    "names": lambda root: pictures(root, ("bowl_0.tif", "bowl_45.tif", "bowl_90.tif")),
    "capture.toml": listed,
    "capture.toml, clockwise": lambda root: listed(root, clockwise="true"),
}


def angle_of_photographs(understood):
    """Polarizer axis [degrees] of each photograph, by its bytes."""
    return {
        frame.digest.partition(" ")[0]: round(float(degrees), 3) % 180
        for shot, degrees in zip(understood.shots, np.degrees(understood.angle))
        for frame in shot.frames
    }


def follow(advice, root):
    """Do what the advice states; the options that it adds to the command."""
    options: dict[str, Any] = {"clockwise": "add --clockwise" in advice}
    if moves := re.search(r"rename the (?:folder|file)s? (.*?)(?:$|, and )", advice):
        pairs = [pair.split(" to ") for pair in moves[1].split(" and ")]
        for old, new in pairs:
            (root / old).rename(root / f"{new}.moved")
        for _, new in pairs:
            (root / f"{new}.moved").rename(root / new)
    file = root / "capture.toml"
    if changes := re.search(r"change the angles? in capture.toml: (.*?)(?:$|, and )", advice):
        changed = dict(pair.split(" to ") for pair in changes[1].split(" and "))
        number = re.compile(r"(?<=angle = )\S+")
        file.write_text(number.sub(lambda found: changed.get(found[0], found[0]), file.read_text()))
    if order := re.search(r"--angles (\S+?)(?:$|, and )", advice):
        options["angles_deg"] = tuple(map(float, order[1].split(",")))
    if "leave out --clockwise, and clockwise in capture.toml" in advice:
        file.write_text(file.read_text().replace("clockwise = true", ""))
    return options


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_advice_on_the_order_of_the_angles_is_followed_literally(tmp_path, layout, order):
    root = LAYOUTS[layout](tmp_path / "krug")
    before = capture.read(root)
    stated = before.angle
    right = (-1 if order.mirrored else 1) * stated[list(order.shots)]
    turned = tuple(replace(shot, angle=angle) for shot, angle in zip(before.shots, right))
    expected = angle_of_photographs(replace(before, shots=turned))
    options = follow(angle_advice.correct(before.angles, order, stated), root)
    assert angle_of_photographs(capture.read(root, **options)) == expected


@pytest.mark.parametrize(
    ("picture", "cells"),
    [
        (lambda frame: frame[:, ::-1], [[135, 90], [0, 45]]),
        (lambda frame: frame[::-1], [[45, 0], [90, 135]]),
        (lambda frame: frame[::-1, ::-1], [[0, 135], [45, 90]]),
        (np.rot90, [[135, 90], [0, 45]]),
    ],
)
def test_a_turned_picture_of_a_polarization_sensor_is_read_by_its_cells(tmp_path, picture, cells):
    """Mirrored or turned by the driver: the axes of the filters turn with the picture."""
    save(tmp_path / "frame.png", np.ascontiguousarray(picture(mosaic())))
    (tmp_path / "capture.toml").write_text(f"cells = {cells}\n")
    shots = {round(np.degrees(shot.angle)): shot.frames[0] for shot in capture.read(tmp_path).shots}
    light = {angle: frame_decoder.decode(frame).value.mean() for angle, frame in shots.items()}
    # of S = (2000, 600, 300) where nothing is turned: S1 changes its sign with a quarter turn, S2 with a mirror too
    mirrored, quarter = picture is not np.rot90 and cells != [[0, 135], [45, 90]], picture is np.rot90
    s1, s2 = (-600 if quarter else 600), (-300 if mirrored or quarter else 300)
    assert light == {0: 1000 + s1 / 2, 45: 1000 + s2 / 2, 90: 1000 - s1 / 2, 135: 1000 - s2 / 2}


@pytest.mark.parametrize("order", [ShotOrder((2, 1, 0, 3)), ShotOrder((1, 2, 3, 0)), ShotOrder((0, 1, 2, 3), True)])
def test_advice_for_a_polarization_sensor_are_cells(tmp_path, order):
    save(tmp_path / "frame.png", mosaic())
    before = capture.read(tmp_path)
    advice = angle_advice.correct(before.angles, order, before.angle)
    assert "folder" not in advice and "clockwise" not in advice
    cells = re.search(r"cells = .*", advice)
    (tmp_path / "capture.toml").write_text(f"{cells[0]}\n")
    after = {shot.frames[0].reading.cell: round(np.degrees(shot.angle)) for shot in capture.read(tmp_path).shots}
    right = (-1 if order.mirrored else 1) * np.degrees(before.angle)[list(order.shots)] % 180
    assert after == {shot.frames[0].reading.cell: round(one) for shot, one in zip(before.shots, right)}


def test_three_of_a_sensor_s_angles_give_all_cells():
    statement = AngleStatement("cells", cells=((1, 1), (0, 1), (0, 0)))
    advice = angle_advice.correct(statement, ShotOrder((0, 1, 2), True), np.radians([0, 45, 90]))
    assert advice.endswith("cells = [[90, 135], [45, 0]]")
    turned = angle_advice.turn(statement, np.radians([0, 45, 90]), np.pi / 2)
    assert turned.endswith("cells = [[0, 135], [45, 90]]")


def test_a_ring_calibrated_as_clockwise_is_calibrated_again():
    """--clockwise would be refused."""
    calibrated = AngleStatement(clockwise="calibrated")
    advice = angle_advice.correct(calibrated, ShotOrder((0, 1, 2), True), np.radians([0, 45, 90]))
    assert "polcap calibrate" in advice and "--clockwise" not in advice
