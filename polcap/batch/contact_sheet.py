"""Contact sheet and tables of a batch: summary.html, summary.csv and summary.json."""

import csv
import io
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec

from polcap.batch.unit import FINISHED, FOLDER, WORDS, Unit, UnitRecord
from polcap.formats import atomic

_COLUMNS = ("name", "state", "verdict", "expected_error_deg", "seconds", "attempts", "asset", "report", "says")
_STYLE = """
body { font: 14px/1.4 system-ui, sans-serif; margin: 1.5em; color: #222 } img { background: #000; display: block }
table { border-collapse: collapse } td, th { text-align: left; padding: .2em .8em .2em 0; vertical-align: top }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, 256px); gap: 12px } figcaption { font-size: 12px }
.done { color: #176617 } .gates { color: #9a5b00 } .failed, .bug, .crashed { color: #b00000; font-weight: bold }
"""


def summary(records: Sequence[UnitRecord]) -> dict[str, Any]:
    """Content of a batch's summary.json: counts, and one row per capture."""
    counts = Counter(record.state for record in records)
    return {
        "captures": len(records),
        "finished": sum(counts[state] for state in FINISHED),
        "states": dict(sorted(counts.items())),
        "seconds": round(sum(record.seconds for record in records), 3),
        "rows": [msgspec.to_builtins(record) for record in records],
    }


def write(batch_folder: Path, units: Sequence[Unit], records: Sequence[UnitRecord]) -> None:
    """Write summary.html, summary.csv and summary.json into the batch's folder."""
    totals = summary(records)
    text = io.StringIO()
    table = csv.DictWriter(text, _COLUMNS, extrasaction="ignore")
    table.writeheader()
    table.writerows(totals["rows"])
    atomic.write_json(batch_folder / "summary.json", totals)
    atomic.write(batch_folder / "summary.csv", text.getvalue())
    atomic.write(batch_folder / "summary.html", _page(totals, units, records))


def _page(totals: dict[str, Any], units: Sequence[Unit], records: Sequence[UnitRecord]) -> str:
    states = ", ".join(f"{count} {WORDS[state]}" for state, count in totals["states"].items())
    lines = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{FOLDER}</title><style>{_STYLE}</style>',
        f"<h1>{totals['finished']} of {totals['captures']} captures finished ({escape(states)})</h1>",
    ]
    wrong = [record for record in records if record.state != "done"]
    if wrong:
        lines.append("<table><tr><th>capture</th><th></th><th>reason and remedy</th></tr>")
        lines += [
            f'<tr><td>{escape(r.name)}</td><td class="{r.state}">{WORDS[r.state]}</td><td>{escape(r.message)}</td></tr>'
            for r in wrong
        ]
        lines.append("</table>")
    lines.append('<div class="sheet">')
    for unit, record in zip(units, records, strict=True):
        if unit.thumbnail_file.exists():
            picture = f'<img loading="lazy" width="256" height="128" src="thumbnails/{quote(unit.slug)}.jpg" alt="">'
            error = "" if record.expected_error_deg is None else f", normals {record.expected_error_deg:.1f}°"
            caption = f'<span class="{record.state}">{escape(record.name)}</span> {record.verdict}{error}'
            caption += f', {record.seconds:.1f} s, <a href="{quote(record.asset)}">GLB</a>'
            page = f'<a href="{quote(record.report)}">{picture}</a>'
            lines.append(f"<figure>{page}<figcaption>{caption}</figcaption></figure>")
    return "\n".join([*lines, "</div></html>", ""])
