"""Size of a result's report, and how fast its light follows the pointer on a software renderer.

python tests/benchmarks/bench_report.py RESULT [--side 512] [--draws 120]
"""

import argparse
import json
from pathlib import Path

import numpy as np

from tests.render import devtools

# each drag is drawn to its end: reading a pixel waits for it
_DRAG = """(() => {
  const { canvas, painter } = relight, gl = painter.gl, pixel = new Uint8Array(4), spent = [];
  [canvas.width, canvas.height] = [%d, %d];
  for (let k = 0; k < %d; k++) {
    const start = performance.now(), turn = 0.1 * k;
    relight.aim(0.6 * Math.cos(turn), 0.6 * Math.sin(turn));
    relight.draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    spent.push(performance.now() - start);
  }
  return spent;
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
        spent = np.array(tab.evaluate(_DRAG % (given.side, given.side, given.draws)))[5:]
        complaints = list(tab.complaints)
    figures = {
        "bytes": page.stat().st_size,
        "draw_ms": {"median": round(float(np.median(spent)), 2), "p95": round(float(np.percentile(spent, 95)), 2)},
        "frames_per_s": round(1000 / float(np.median(spent)), 1),
        "complaints": complaints,
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
