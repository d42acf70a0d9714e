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

import argparse
import json
import shutil
import sys
import traceback
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import plant_weaknesses

from polcap.chart_values import ChartRequest
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats.capture import reader as captures
from polcap.pipeline import models, path
from polcap.pipeline.cache import MemoryCache
from polcap.quality import gates
from polcap.quality.gate_values import full_size
from polcap.results import Results
from polcap.stage_values import Network, SurfaceMaps

Row = dict[str, Any]
WORSE_DEG, WORSE_ROUGHNESS, WORSE_SCALE = 1.0, 0.04, 0.10  # beyond the capture without the weakness
OUTCOMES = ("handled", "reported", "silent", "false alarm", "crash")


def main() -> None:
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("folder", type=Path)
    parse.add_argument("--seeds", default="5000-5009")
    parse.add_argument("--kinds", default=",".join(plant_weaknesses.KINDS))
    parse.add_argument("--tally", action="store_true")
    options = parse.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    log = options.folder / "rows.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    done = {(row["seed"], row["kind"]) for row in rows}
    first, last = (int(part) for part in options.seeds.split("-"))
    for seed in () if options.tally else range(first, last + 1):
        for kind in options.kinds.split(","):
            if (seed, kind) in done:
                continue
            row = judge(options.folder, seed, kind)
            rows.append(row)
            with log.open("a") as out:
                out.write(json.dumps(row) + "\n")
            print(json.dumps(row), flush=True)
    print(table(rows))


def judge(folder: Path, seed: int, kind: str) -> Row:
    """Shoot and process one capture; its errors, and the gates that did not pass."""
    place = folder / f"{seed}-{kind.replace(' ', '-').replace('%', '')}"
    shutil.rmtree(place, ignore_errors=True)
    row: Row = {"seed": seed, "kind": kind}
    plant_weaknesses.write(place, seed, kind)
    try:
        row |= _processed(place, ChartRequest("none" if kind in ("no chart", "all out of focus by 3 px") else "auto"))
    except InputError as error:
        row |= {"verdict": "refused", "gates": {type(error).__name__: ["fail", str(error)]}}
    except Exception:
        row |= {"verdict": "crash", "gates": {}, "traceback": traceback.format_exc()}
    shutil.rmtree(place)
    return row


def _processed(place: Path, chart: ChartRequest) -> Row:
    capture = captures.read(place)
    found = path.path(capture, path.UserInput(chart, None, *networks()), Config(), MemoryCache(), Results)
    lines = gates.judge(full_size(found, capture.focal_doubt), Config().gates)
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
    step, (x0, y0) = round(maps.view.scale), (round(at) for at in maps.view.origin)
    height, width = maps.mask.shape
    cut = np.s_[step * y0 : step * (y0 + height) : step, step * x0 : step * (x0 + width) : step]
    seen = truth["mask"][cut] & maps.mask
    if not seen.any():
        return {"normal_mean": None}
    normal = truth["normal"][cut].astype(np.float32)[seen]
    angle = np.degrees(np.arccos(np.clip((normal * maps.normal[seen]).sum(-1), -1, 1)))
    true, found = truth["diffuse"][cut][seen].astype(np.float64).sum(-1), maps.diffuse[seen].sum(-1)
    rough = np.abs(maps.roughness[seen] - truth["roughness"][cut][seen])
    return {
        "normal_mean": round(float(angle.mean()), 2),
        "normal_median": round(float(np.median(angle)), 2),
        "roughness": round(float(rough.mean()), 4),
        "scale": round(float(np.median(np.log(np.maximum(found, 1e-4) / np.maximum(true, 1e-4)))), 4),
        "specular": round(float(np.median(maps.specular[seen].mean(-1) - truth["specular"][cut][seen].mean(-1))), 4),
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


def table(rows: list[Row]) -> str:
    """A Markdown row per kind: outcomes, median errors and the gates that spoke most often."""
    usual = {row["seed"]: row for row in rows if row["kind"] == "none" and row["verdict"] != "crash"}
    names = ["weakness", "captures", *OUTCOMES, "normals", "roughness", "scale", "gates"]
    lines = ["| " + " | ".join(names) + " |", "| --- " * len(names) + "|"]
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
        cells = [kind, len(of_kind), *(counts[name] for name in OUTCOMES), *medians, spoke]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


@cache
def networks() -> tuple[Network | None, Network | None]:
    return models.load_network(None, None, "cpu", 1), models.load_mask_network(1)


if __name__ == "__main__":
    main()
