"""Whether `process` handles or reports weak captures: small motion, other light, doubtful charts, harmless oddities.

python tests/benchmarks/bench_weaknesses.py FOLDER [--seeds 5000-5009] [--kinds KIND,KIND] [--tally]

Each capture is compared with the same capture without its weakness. FOLDER/rows.jsonl gets one line per capture, so a
stopped run continues. The table counts:

handled      maps as good as without the weakness, verdict not fail
reported     worse maps, and a gate of the weakness warns or fails, or the expected error covers the actual one
             (normals), or the gate of the albedo's scale warns (albedo)
silent       worse maps, and neither
false alarm  maps as good, verdict fail
crash        an exception that is no error message
"""

import json
import shutil
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import plant_weaknesses

from polcap.errors import InputError
from polcap.optics import frames
from polcap.quality import gates
from polcap.stage_values import SurfaceMaps
from tests.experiments import Rows, arguments, judge, raw_pixels, table

Row = dict[str, Any]
WORSE_DEG, WORSE_ROUGHNESS, WORSE_SCALE = 1.0, 0.04, 0.10  # beyond the capture without the weakness
OUTCOMES = ("handled", "reported", "silent", "false alarm", "crash")


def main() -> None:
    options = arguments(__doc__, "folder", "--tally", seeds="5000-5009", kinds=",".join(plant_weaknesses.KINDS))
    rows = Rows(options.folder / "rows.jsonl")
    done = rows.done("seed", "kind")
    first, last = (int(part) for part in options.seeds.split("-"))
    for seed in () if options.tally else range(first, last + 1):
        for kind in options.kinds.split(","):
            if (seed, kind) not in done:
                rows.add(measure(options.folder, seed, kind))
                print(json.dumps(rows.all[-1]), flush=True)
    print(summary(rows.all))


def measure(folder: Path, seed: int, kind: str) -> Row:
    """Shoot and process one capture; its errors, and the gates that did not pass."""
    place = folder / f"{seed}-{kind.replace(' ', '-').replace('%', '')}"
    shutil.rmtree(place, ignore_errors=True)
    row: Row = {"seed": seed, "kind": kind}
    plant_weaknesses.write(place, seed, kind)
    try:
        row |= _processed(place, "none" if kind in ("no chart", "all out of focus by 3 px") else "auto")
    except InputError as error:
        row |= {"verdict": "refused", "gates": {type(error).__name__: ["fail", str(error)]}}
    except Exception:
        row |= {"verdict": "crash", "gates": {}, "traceback": traceback.format_exc()}
    shutil.rmtree(place)
    return row


def _processed(place: Path, chart: str) -> Row:
    found, lines = judge(place, chart=chart)
    spoke = {line.name: [line.state, line.value, line.cost_deg, line.message] for line in lines if line.state != "pass"}
    expected = next((line.value for line in lines if line.name == "normal error"), None)
    own = float(np.median(found.maps.confidence[found.maps.mask]))
    return {
        "verdict": gates.verdict(lines), "gates": spoke, "expected": expected, "own": round(own, 2),
        "scale_sigma": found.maps.albedo_sigma, **errors(found.maps, place),
    }  # fmt: skip


def errors(maps: SurfaceMaps, place: Path) -> Row:
    """Errors of the maps: mean and median of the normals, median of roughness, ln of the albedos' common scale."""
    truth = np.load(place / "truth.npz")
    step, cut = raw_pixels(maps)
    with np.load(place / "truth.npz") as file:
        truth = {name: file[name][cut][::step, ::step] for name in file.files}
    seen = truth["mask"] & maps.mask
    if not seen.any():
        return {"normal_mean": None}
    angle = frames.angle_deg(truth["normal"].astype(np.float32)[seen], maps.normal[seen])
    true, found = truth["diffuse"][seen].astype(np.float64).sum(-1), maps.diffuse[seen].sum(-1)
    rough = np.abs(maps.roughness[seen] - truth["roughness"][seen])
    return {
        "normal_mean": round(float(angle.mean()), 2),
        "normal_median": round(float(np.median(angle)), 2),
        "roughness": round(float(rough.mean()), 4),
        "scale": round(float(np.median(np.log(np.maximum(found, 1e-4) / np.maximum(true, 1e-4)))), 4),
        "specular": round(float(np.median(maps.specular[seen].mean(-1) - truth["specular"][seen].mean(-1))), 4),
    }


def outcome(row: Row, usual: Row | None) -> str:
    """The column of the table; `usual` is the same capture without the weakness."""
    if row["verdict"] == "crash":
        return "crash"
    spoke = {name for name, what in row["gates"].items() if what[0] in ("warn", "fail")}
    named = bool(spoke & set(plant_weaknesses.KINDS[row["kind"]]))
    if row.get("normal_mean") is None:
        return "reported" if row["verdict"] in ("refused", "fail") else "silent"
    before = usual or {"normal_mean": row["normal_mean"], "roughness": row["roughness"], "scale": row["scale"]}
    worse = row["normal_mean"] - before["normal_mean"] > WORSE_DEG
    rough = row["roughness"] - before["roughness"] > WORSE_ROUGHNESS
    dim = abs(row["scale"] - before["scale"]) > max(WORSE_SCALE, 2 * (row.get("scale_sigma") or 0))
    if not (worse or rough or dim):
        return "false alarm" if row["verdict"] == "fail" else "handled"
    if named or row["verdict"] == "fail":
        return "reported"
    covered = row["expected"] >= row["normal_median"] and row["expected"] > row["own"]
    return "silent" if rough or (worse and not covered) or (dim and "albedo scale" not in spoke) else "reported"


def summary(rows: list[Row]) -> str:
    """A Markdown row per kind: outcomes, median errors and the gates that spoke most often."""
    usual = {row["seed"]: row for row in rows if row["kind"] == "none" and row["verdict"] != "crash"}
    names = ["weakness", "captures", *OUTCOMES, "normals", "roughness", "scale", "gates"]
    lines = []
    for kind in plant_weaknesses.KINDS:
        of_kind = [row for row in rows if row["kind"] == kind]
        if not of_kind:
            continue
        counts = Counter(outcome(row, usual.get(row["seed"]) if kind != "none" else None) for row in of_kind)
        whole = [row for row in of_kind if row.get("normal_mean") is not None]
        normals, rough, dim = (
            float(np.median([abs(row[name]) for row in whole])) if whole else float("nan")
            for name in ("normal_mean", "roughness", "scale")
        )
        states = Counter(f"{name} {what[0]}" for row in of_kind for name, what in row["gates"].items())
        spoke = ", ".join(f"{name} {count}" for name, count in states.most_common(6) if "not measured" not in name)
        medians = [f"{normals:.1f}°", f"{rough:.3f}", f"{dim:.2f}"]
        lines.append([kind, len(of_kind), *(counts[name] for name in OUTCOMES), *medians, spoke])
    return table(lines, names)


if __name__ == "__main__":
    main()
