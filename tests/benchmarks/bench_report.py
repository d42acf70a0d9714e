"""Size of a result's report, and how fast its light follows the pointer on a software renderer.

python tests/benchmarks/bench_report.py RESULT [--side 512] [--draws 120]
"""

import argparse
import json
from pathlib import Path

import numpy as np

from tests.render import devtools

# each drag is drawn to its end: `follow` waits for it, and reading a pixel does where the whole is drawn
_DRAG = """(() => {
  const gl = relight.painter.gl, pixel = new Uint8Array(4), moving = [], whole = [];
  relight.size = [%d, %d];
  for (let k = 0; k < %d; k++) {
    const turn = 0.1 * k;
    relight.aim(0.6 * Math.cos(turn), 0.6 * Math.sin(turn));
    const start = performance.now();
    relight.follow();
    moving.push(performance.now() - start);
  }
  const share = relight.share;
  for (let k = 0; k < %d; k++) {
    const start = performance.now();
    relight.draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    whole.push(performance.now() - start);
  }
  return [moving, whole, share];
})()"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("result", type=Path)
    parser.add_argument("--side", type=int, default=512)
    parser.add_argument("--draws", type=int, default=120)
    given = parser.parse_args()
    page = (given.result / "report.html").resolve()
    with devtools.opened() as tab:
        tab.open(page, 1280, 900)
        moving, whole, share = tab.evaluate(_DRAG % (given.side, given.side, given.draws, given.draws // 4))
        complaints = list(tab.complaints)
    figures = {
        "bytes": page.stat().st_size,
        "moving": pace(moving[5:]) | {"share_of_the_side": share},
        "whole": pace(whole[5:]),
        "complaints": complaints,
    }
    print(json.dumps(figures, indent=1))


def pace(spent: list[float]) -> dict[str, float]:
    middle, slow = np.percentile(spent, [50, 95])
    return {"ms": round(float(middle), 2), "p95_ms": round(float(slow), 2), "per_s": round(1000 / float(middle), 1)}


if __name__ == "__main__":
    main()
