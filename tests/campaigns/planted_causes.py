"""One cause, one remedy: plants causes in simulated captures and does what polcap advises.

python -m tests.campaigns.planted_causes [--folder FOLDER] [--rows FILE] [--only NAME] [--width 512] [--report]

Each row plants one cause, or two, in a capture of three angles and three exposures, and runs `check` and `process`.
It notes whether the first printed remedy is the right one, how many are printed, whether both commands agree on keep
or repeat, and whether the remedy, followed to the letter, ends in `keep`: named shots are taken again without the
cause, named files are moved away or renamed, the light is taken down by the stated number of stops. Rows in the file
are not run again. --report prints the table of a file.
"""

import itertools
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter, shift, uniform_filter1d

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.formats.raw import libraw, probe
from polcap.image_values import Floats
from polcap.pipeline import check, models, run
from polcap.pipeline.path import UserInput
from polcap.quality.advice import advice
from polcap.quality.gate_values import Gate
from polcap.stage_values import Network
from polcap.synth import forward_camera, scenes
from polcap.synth.shooting import Shoot, ShotPose, Studio, Take
from tests.experiments import Rows, arguments, table

ANGLES = (0, 45, 90)
KINDS: tuple[scenes.Kind, ...] = ("bumps", "clusters", "vase")
Change = Callable[[Floats, int, int], Floats]  # light (H, W, 3) of frame e of shot k -> light
Plant = Callable[["Shooting"], None]
SHOWN = ("name", "right", "printed", "agree", "after", "finding", "first")


@dataclass
class Shooting:
    """A capture to be photographed, and all that a cause may change."""

    studio: Studio
    actual: list[float] = field(default_factory=lambda: [float(angle) for angle in ANGLES])  # degrees
    names: list[int] = field(default_factory=lambda: [0, 1, 2])  # index of the angle that names the folder
    moved: list[tuple[float, float]] = field(default_factory=lambda: [(0.0, 0.0), (0.6, -0.4), (-0.5, 0.7)])  # px
    lights: list[Change] = field(default_factory=list)
    after: list[Callable[[Path], None]] = field(default_factory=list)
    times: float = 1.0  # of the light

    def write(self, folder: Path, shots: tuple[int, ...] = (0, 1, 2)) -> None:
        """Photograph these shots."""
        for k in shots:
            light = self.times * self.studio.radiance(ShotPose(self.actual[k], self.moved[k]))
            for e in range(3):
                changed = light
                for change in self.lights:
                    changed = change(changed, k, e)
                place = file_of(folder, self.names[k], e, k)
                place.parent.mkdir(parents=True, exist_ok=True)
                self.studio.photograph(place, changed, Take(k, e, self.studio.shoot.step ** (e - 1)))
        for change_files in self.after:
            change_files(folder)


def file_of(folder: Path, k: int, e: int, number: int | None = None) -> Path:
    """Photograph e of the folder of angle k."""
    return folder / f"pol{ANGLES[k]:03d}" / f"IMG_{3 * (k if number is None else number) + e + 1:04d}.DNG"


def studio(seed: int, width: int, **scene: Any) -> Studio:
    made = msgspec.structs.replace(scenes.random_scene(seed, KINDS[seed % 3]), **scene)
    return Studio(made, Shoot(seed=seed, width=width, height=width * 3 // 4, samples=1))


def clipped(times: float, shot: int | None = None) -> Plant:
    """More light than the darkest exposure holds: `times` that of its 85th percentile."""

    def plant(to: Shooting) -> None:
        lit = to.studio.through(0)[to.studio.buffer.mask].max(-1) * to.studio.middle / to.studio.shoot.step
        factor = times / float(np.percentile(lit, 85))
        if shot is None:
            to.times = factor
        else:
            to.lights.append(lambda light, k, e: factor * light if k == shot else light)

    return plant


def frame_light(change: Callable[[Floats], Floats], shot: int | None, frame: int | None = None) -> Plant:
    """Change the light of one shot, of one of its frames, or of all shots."""

    def plant(to: Shooting) -> None:
        to.lights.append(lambda light, k, e: change(light) if shot in (None, k) and frame in (None, e) else light)

    return plant


def blurred(sigma: float, shot: int | None, frame: int | None = None) -> Plant:
    return frame_light(lambda light: gaussian_filter(light, sigma, axes=(0, 1)), shot, frame)


def shaken(length: int, shot: int, frame: int | None = None) -> Plant:
    return frame_light(lambda light: uniform_filter1d(light, length, 1), shot, frame)


def frame_moved(px: float, shot: int, frame: int) -> Plant:
    return frame_light(lambda light: shift(light, (0, px, 0), order=1, mode="nearest"), shot, frame)


def energy(factor: float, shot: int, frame: int | None = None) -> Plant:
    return frame_light(lambda light: factor * light, shot, frame)


def shot_moved(px: float, shot: int) -> Plant:
    def plant(to: Shooting) -> None:
        to.moved[shot] = (px, px / 2)

    return plant


def pushed(px: int, shot: int) -> Plant:
    """The object alone moves."""

    def plant(to: Shooting) -> None:
        there = np.roll(to.studio.buffer.mask, px, 1)[..., None]
        to.lights.append(lambda light, k, e: np.where(there, np.roll(light, px, 1), light) if k == shot else light)

    return plant


def other_object(shot: int, frame: int | None = None) -> Plant:
    """The files are of another capture by the same camera."""

    def plant(to: Shooting) -> None:
        without = {"chart": None} if to.studio.scene.chart is None else {}
        other = studio(to.studio.shoot.seed + 7, to.studio.shoot.width, **without)
        light = other.through(ANGLES[shot])
        to.lights.append(lambda own, k, e: light if k == shot and frame in (None, e) else own)

    return plant


def lamp(share: float, shot: int | None, place: tuple[float, float, float] = (0.6, 0.3, 0.0)) -> Plant:
    """Another lamp adds a share of the light, in one shot or in all."""

    def plant(to: Shooting) -> None:
        own = to.studio
        other = Studio(msgspec.structs.replace(own.scene, light=place), own.shoot)
        inside = own.buffer.mask
        factor = share * own.reference[0][inside].mean() / other.reference[0][inside].mean()

        def add(light: Floats, k: int, e: int) -> Floats:
            return light + factor * other.through(to.actual[k]) if shot in (None, k) else light

        to.lights.append(add)

    return plant


def hand(shot: int, frame: int | None) -> Plant:
    """Something dark covers a part of the object."""

    def plant(to: Shooting) -> None:
        y, x = np.nonzero(to.studio.buffer.mask)
        middle, radius = (round(x.mean()), round(y.mean())), round(0.5 * np.sqrt(len(x) / np.pi))
        cover = cv2.circle(np.zeros(to.studio.buffer.mask.shape, np.float32), middle, radius, 1.0, -1)[..., None]
        frame_light(lambda light: light * (1 - 0.9 * cover), shot, frame)(to)

    return plant


def angle(shot: int, error_deg: float) -> Plant:
    def plant(to: Shooting) -> None:
        to.actual[shot] += error_deg

    return plant


def order(*names: int) -> Plant:
    def plant(to: Shooting) -> None:
        to.names = list(names)

    return plant


def clockwise(to: Shooting) -> None:
    to.actual = [-angle for angle in to.actual]


def without_polarizer(to: Shooting) -> None:
    s0 = 0.5 * to.studio.reference[0] @ to.studio.to_camera.T
    to.lights.append(lambda light, k, e: s0)


def levels(black: int = 0, white: int = 0) -> Plant:
    """The files state another black or white level."""

    def plant(to: Shooting) -> None:
        shoot = to.studio.shoot
        stated = msgspec.structs.replace(
            shoot.sensor, black=shoot.sensor.black + black, white=shoot.sensor.white + white
        )
        cfa = np.array([[0, 1], [1, 2]], np.uint8)

        def state(folder: Path) -> None:
            for file in folder.rglob("*.DNG"):
                image, exif = libraw.read(file), probe.read(file).exif
                file.unlink()
                forward_camera.write_dng(file, np.array(image.value), stated, cfa, shoot.color_matrix, exif)

        to.after.append(state)

    return plant


def scene(**changes: Any) -> Plant:
    """Another scene: the chart elsewhere, the light from elsewhere."""

    def plant(to: Shooting) -> None:
        own = to.studio
        to.studio = Studio(msgspec.structs.replace(own.scene, **changes), own.shoot, own.middle)

    return plant


def chart(metres: float) -> Plant:
    """The chart stands behind the object, or before it."""

    def plant(to: Shooting) -> None:
        found = to.studio.scene.chart
        assert found is not None
        x, y, z = found.center
        times = (z - metres) / z
        scene(chart=msgspec.structs.replace(found, center=(x * times, y * times, z - metres)))(to)

    return plant


def chart_moved(shot: int) -> Plant:
    def plant(to: Shooting) -> None:
        own, found = to.studio, to.studio.scene.chart
        assert found is not None
        x, y, z = found.center
        away = msgspec.structs.replace(found, center=(x + 0.01, y + 0.012, z))
        other = Studio(msgspec.structs.replace(own.scene, chart=away), own.shoot, own.middle)
        to.lights.append(lambda light, k, e: other.through(to.actual[k]) if k == shot else light)

    return plant


def chart_lit_less(to: Shooting) -> None:
    """The chart is in the shadow of something."""
    column = np.arange(to.studio.buffer.mask.shape[1])[:, None]
    edge = 0.62 * len(column)
    to.lights.append(lambda light, k, e: light * np.where(column > edge + to.moved[k][0], 0.4, 1.0))


def chart_in_mirror(to: Shooting) -> None:
    """A part of the chart is covered."""
    height, width = to.studio.buffer.mask.shape
    cover = np.ones((height, width, 1))
    cover[height // 2 :, int(0.7 * width) :] = 0.1
    to.lights.append(lambda light, k, e: light * cover)


def dark(times: float) -> Plant:
    def plant(to: Shooting) -> None:
        to.times = times

    return plant


def equal_frames(to: Shooting) -> None:
    """A flash exposure is bracketed by the shutter time."""
    to.lights.append(lambda light, k, e: light * to.studio.shoot.step ** (1 - e))


def files(change: Callable[[Path], Any]) -> Plant:
    def plant(to: Shooting) -> None:
        to.after.append(change)

    return plant


@dataclass(frozen=True)
class Cause:
    """A cause, and the words of its right remedy."""

    plant: Plant
    remedy: str  # regular expression
    harmless: bool = False  # the capture may also be kept


RETAKE = r"[Tt]ake (that|this|the) (shot|bracket)s? again"
LESS, FILES = r"stops? less light|as much light", r"[Mm]ove .*IMG_"
CAUSES = {
    **{f"clipped {n:g} times": Cause(clipped(n), LESS, n < 1) for n in (0.5, 0.8, 1.5, 4, 16, 60)},
    "clipped in 45°": Cause(clipped(3, 1), LESS),
    "clipped in 0°": Cause(clipped(8, 0), LESS),
    **{f"black {n:+d}": Cause(levels(black=n), r"black|own RAW", True) for n in (2, -2, 4, -4)},
    **{f"black {n:+d}": Cause(levels(black=n), r"black|own RAW") for n in (60, -120)},
    "white 12000": Cause(levels(white=-3871), r"white|own RAW|stops? less light", True),
    **{f"frame {e} of {ANGLES[k]}° blurred by {s:g}": Cause(blurred(s, k, e), FILES + "|" + RETAKE)
       for k, e, s in ((1, 0, 3), (1, 1, 2), (2, 1, 6), (0, 2, 4), (2, 2, 2.5))},
    "frame 2 of 90° shaken": Cause(shaken(9, 2, 1), FILES + "|" + RETAKE),
    "45° blurred": Cause(blurred(3, 1), r"[Ff]ocus"),
    "0° blurred": Cause(blurred(3, 0), r"[Ff]ocus"),
    "all blurred": Cause(blurred(3, None), r"[Ff]ocus"),
    **{f"frame {e} of {ANGLES[k]}° moved by {px} px": Cause(frame_moved(px, k, e), FILES + "|tripod|" + RETAKE, True)
       for k, e, px in ((1, 0, 4), (2, 2, 12), (0, 1, 90), (1, 2, 70))},
    **{f"{ANGLES[k]}° moved by {px} px": Cause(shot_moved(px, k), r"[Ll]ock the camera", px < 60)
       for k, px in ((1, 30), (2, 110), (1, 140))},
    **{f"object pushed by {px} px in {ANGLES[k]}°": Cause(pushed(px, k), r"[Ff]ix the object")
       for k, px in ((1, 4), (2, 8))},
    "another object in 90°": Cause(other_object(2), r"[Cc]heck .*(files|pol090)|pol090"),
    "another object in 45°": Cause(other_object(1), r"[Cc]heck .*(files|pol045)|pol045"),
    "another object in 0°": Cause(other_object(0), r"[Cc]heck .*(files|pol000)|pol000"),
    "another object in frame 2 of 45°": Cause(other_object(1, 1), r"IMG_0005|pol045"),
    "another object in frame 3 of 90°": Cause(other_object(2, 2), r"IMG_0009|pol090"),
    "0° and 45° swapped": Cause(order(1, 0, 2), r"pol000 to pol045"),
    "45° and 90° swapped": Cause(order(0, 2, 1), r"pol045 to pol090"),
    "all shots swapped round": Cause(order(1, 2, 0), r"[Rr]ename"),
    "clockwise": Cause(clockwise, r"clockwise"),
    "45° turned by 20°": Cause(angle(1, 20), r"ring|mark"),
    "90° not turned": Cause(angle(2, -45), r"ring|mark"),
    "no polarizer": Cause(without_polarizer, r"polarizer"),
    "a lamp in 45°": Cause(lamp(0.15, 1), r"lamp|[Dd]arken"),
    "a lamp in 90°": Cause(lamp(0.4, 2), r"lamp|[Dd]arken"),
    "a lamp in all shots": Cause(lamp(0.3, None), r"[Dd]arken|one flash|lamp", True),  # costs .7°
    "a second flash": Cause(lamp(1.0, None, (0.5, 0.05, 0.0)), r"one flash|lamp|[Dd]arken"),
    "softboxes": Cause(lamp(3.0, None, (-0.8, 0.4, 0.0)), r"one flash|lamp|[Dd]arken"),
    "45° with 40 % less light": Cause(energy(0.6, 1), r"flashes|constant light|lamp"),
    "frame 2 of 45° with 40 % less light": Cause(energy(0.6, 1, 1), r"flashes|constant light|[Mm]ove .*IMG_"),
    "frame 3 of 90° black": Cause(energy(0.0, 2, 2), r"IMG_0009|flashes|constant light"),
    "a hand in frame 2 of 45°": Cause(hand(1, 1), r"IMG_0005|" + RETAKE),
    "a hand in frame 1 of 90°": Cause(hand(2, 0), r"IMG_0007|" + RETAKE),
    "a hand in 90°": Cause(hand(2, None), r"[Ff]ix the object|again"),
    "frame of 45° missing": Cause(files(lambda folder: file_of(folder, 1, 1).unlink()), r"IMG_0002.*IMG_0008"),
    "frame of 0° missing": Cause(files(lambda folder: file_of(folder, 0, 0).unlink()), r"IMG_0004.*IMG_0007"),
    "a frame twice": Cause(
        files(lambda folder: shutil.copy(file_of(folder, 1, 1), folder / "pol045" / "IMG_0005b.DNG")), r"remove one"
    ),
    "pol090 missing": Cause(files(lambda folder: shutil.rmtree(folder / "pol090")), r"missing shot|90"),
    "chart 25 cm behind": Cause(chart(0.25), r"[Ll]ight the chart|ColorChecker"),
    "chart 20 cm before": Cause(chart(-0.2), r"[Ll]ight the chart|ColorChecker"),
    "chart in the shade": Cause(chart_lit_less, r"[Ll]ight the chart|ColorChecker"),
    "chart moved in 45°": Cause(chart_moved(1), r"chart|ColorChecker", True),
    "chart half covered": Cause(chart_in_mirror, r"chart"),
    "no chart": Cause(scene(chart=None), r"chart|ColorChecker"),
    "too little light": Cause(dark(1 / 400), r"more light"),
    "a little too little light": Cause(dark(1 / 60), r"more light", True),
    "equal frames": Cause(equal_frames, r"[Bb]racket by flash power"),
    "object at the border": Cause(scene(position=(-0.19, 0.0, -0.72)), r"backdrop|object"),
}  # fmt: skip
PAIRS = [
    ("clipped 4 times", "a lamp in 45°"), ("clipped 16 times", "clockwise"), ("clipped 1.5 times", "no chart"),
    ("black +60", "frame 2 of 90° shaken"), ("black -120", "0° and 45° swapped"),
    ("45° blurred", "90° moved by 110 px"),
    ("a lamp in all shots", "all blurred"), ("all blurred", "no chart"), ("another object in 90°", "clipped 4 times"),
    ("another object in 45°", "no chart"), ("0° and 45° swapped", "no chart"), ("clockwise", "a lamp in all shots"),
    ("90° not turned", "no chart"), ("45° with 40 % less light", "chart in the shade"),
    ("frame 2 of 45° with 40 % less light", "0° and 45° swapped"), ("a hand in frame 2 of 45°", "clockwise"),
    ("too little light", "no chart"), ("object pushed by 8 px in 90°", "chart in the shade"),
    ("frame 1 of 45° blurred by 2", "chart 25 cm behind"), ("a lamp in 90°", "45° turned by 20°"),
]  # fmt: skip


def trial(
    name: str, folder: Path, seed: int, width: int, networks: tuple[Network | None, Network | None]
) -> dict[str, Any]:
    """Plant the causes of a row, judge, follow the first remedy until the capture is kept or the causes end."""
    planted = name.split(" + ")
    to = arranged(planted, seed, width)
    shutil.rmtree(folder, ignore_errors=True)
    to.write(folder)
    seen, processed = judge(folder, networks), process(folder, networks)
    first = (seen["remedies"] or [""])[0]
    right = any(re.search(CAUSES[one].remedy, first) for one in planted) if first else False
    right = right or (seen["keep"] and all(CAUSES[one].harmless for one in planted))
    row = {"name": name, "seed": seed, "right": right, "printed": len(seen["remedies"]), "keep": seen["keep"],
           "process": processed["keep"], "agree": seen["keep"] == processed["keep"], "finding": seen["finding"],
           "error": seen["error"], "process_error": processed["error"], "first": first,
           "process_printed": len(processed["remedies"]),
           "process_first": (processed["remedies"] or [""])[0]}  # fmt: skip
    for _ in range(len(planted) + 1):  # each cause needs a round; heavy clipping may need two
        if not seen["keep"]:
            planted = follow(seen, folder, to, planted)
            seen = judge(folder, networks)
    first = (seen["remedies"] or [""])[0]
    return row | {"after": seen["keep"], "after_finding": seen["finding"], "after_first": first}


def arranged(planted: list[str], seed: int, width: int) -> Shooting:
    """A capture with these causes."""
    to = Shooting(studio(seed, width))
    for one in planted:
        CAUSES[one].plant(to)
    return to


def judge(folder: Path, networks: tuple[Network | None, Network | None]) -> dict[str, Any]:
    """What `check` prints."""
    try:
        found = check.inspect(captures.read(folder), Config(), networks=lambda: networks)
    except InputError as error:
        return refused(error)
    return {**judged(list(found.lines)), "keep": found.keep, "shots": found.shots, "needs": found.needs}


def process(folder: Path, networks: tuple[Network | None, Network | None]) -> dict[str, Any]:
    """What `process` prints, without a chart where it asks for that."""
    shutil.rmtree(folder / "polcap", ignore_errors=True)
    for chart in ("auto", "none"):
        with suppress(OSError):
            shutil.rmtree(folder / "polcap")
        try:
            supplied = UserInput(ChartRequest(chart), None, *networks)
            about = run.process(captures.read(folder), supplied, Config(), folder / "polcap")
        except InputError as error:
            if chart == "auto" and "--no-chart" in str(error):
                continue
            return refused(error)
        assert about is not None
        return {**judged(msgspec.convert(about["gates"], list[Gate])), "keep": about["verdict"] != "fail"}
    raise AssertionError


def refused(error: InputError) -> dict[str, Any]:
    finding, _, remedy = str(error).partition("; ")
    return {"keep": False, "shots": (), "remedies": [remedy], "finding": f"{finding}", "error": None}


def judged(gates: list[Gate]) -> dict[str, Any]:
    worst = advice(gates)
    errors = [gate.value for gate in gates if gate.name == "normal error"]
    return {
        "remedies": [gate.remedy for gate in worst],
        "finding": "; ".join(f"{gate.name} {gate.state}" for gate in gates if gate.state in ("fail", "warn")),
        "error": errors[0] if errors else None,
    }


def follow(seen: dict[str, Any], folder: Path, to: Shooting, planted: list[str]) -> list[str]:
    """Do what the first remedy says and return the causes that remain.

    A shot is taken again without the cause that the remedy is for, without any if it is for none of them, and with as
    much light as the others now have.
    """
    first = (seen["remedies"] or [""])[0]
    left = [one for one in planted if not re.search(CAUSES[one].remedy, first)]
    left = [] if left == planted else left
    clean = arranged(left, to.studio.shoot.seed, to.studio.shoot.width)
    files = re.findall(r"pol\d+/IMG_\w+\.DNG", first)
    pairs = re.findall(r"(pol\d+) to (pol\d+)", first)
    stops = re.search(r"(\d+) stops? less light", first)
    if pairs:
        for old, new in pairs:
            (folder / old).rename(folder / f"new {new}")
        for _, new in pairs:
            (folder / f"new {new}").rename(folder / new)
    elif "clockwise" in first:
        (folder / "capture.toml").write_text("clockwise = true\n")
    elif stops:
        to.times /= 2 ** int(stops[1])
        again = arranged(planted, to.studio.shoot.seed, to.studio.shoot.width)
        again.times = to.times
        shutil.rmtree(folder)
        again.write(folder)
    elif files:
        for file in files:
            (folder / file).unlink()
    elif seen["shots"]:
        clean.times = to.times
        clean.write(folder, tuple(k for k, angle in enumerate(ANGLES) if f"{angle}°" in seen["shots"]))
    else:  # the cause concerns the whole capture
        shutil.rmtree(folder)
        clean.write(folder)
    return left


def report(rows: Rows) -> None:
    """Print the table and its sums."""
    shown = [(row["name"], row["right"], row["printed"], row["agree"], row["after"], row["first"]) for row in rows.all]
    print(table(shown, ("cause", "right", "printed", "agree", "after", "first remedy")))
    count = len(rows.all)
    sums = {key: sum(bool(row[key]) for row in rows.all) for key in ("right", "agree", "after")}
    few = sum(row["printed"] <= 2 and row["process_printed"] <= 2 for row in rows.all)
    print(f"{count} rows: {sums}, at most two remedies in {few}")


def main(folder: Path, rows: Rows, only: str, width: int) -> None:
    """Run all rows that the file lacks."""
    networks = models.load_networks()
    names = [*CAUSES, *(" + ".join(pair) for pair in PAIRS)]
    done = {name for (name,) in rows.done("name")}
    for name, seed in zip(names, itertools.cycle(range(1, 7))):
        if name not in done and only in name:
            row = trial(name, folder / "capture", seed, width, networks)
            rows.add(row)
            print({key: row[key] for key in SHOWN}, flush=True)


if __name__ == "__main__":
    stated = arguments(__doc__, "--report", folder="/tmp/planted", only="", width=512, rows=Rows())
    if not stated.report:
        main(Path(stated.folder), stated.rows, stated.only, stated.width)
    report(stated.rows)
