"""Contact sheet and tables of a batch: summary.html, summary.csv and summary.json."""

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from polcap.batch.unit import FINISHED, FOLDER, WORDS, Unit, UnitRecord
from polcap.formats import addresses, atomic

EDITABLE = ("summary.csv", "summary.html")  # a run that would replace somebody's edits ends before its first capture
_COLUMNS = (
    "name", "title", "object_number", "creator", "rights", "state", "verdict", "expected_error_deg", "seconds",
    "attempts", "asset", "report", "says",
)  # fmt: skip
_FORMULA = tuple("=+-@\t\r\n＝＋－＠")  # first characters of cells that spreadsheets compute
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="color-scheme" content="light dark"><title>{{ folder }}</title><style>
:root { --pass: #17692b; --warn: #8a5300; --fail: #b3121d }
@media (prefers-color-scheme: dark) { :root { --pass: #6fd388; --warn: #f0b45a; --fail: #ff7b80 } }
body { font: 14px/1.4 system-ui, sans-serif; margin: 1.5em } img { background: #000; display: block }
table { border-collapse: collapse } td, th { text-align: left; padding: .2em .8em .2em 0; vertical-align: top }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, 256px); gap: 12px } figcaption { font-size: 12px }
.done { color: var(--pass) } .done.warn { color: var(--warn) } .gates, .failed, .bug, .crashed { color: var(--fail) }
</style>
<h1>{{ finished }} of {{ captures }} captures finished ({{ states }})</h1>
{% if wrong %}
<table><tr><th>capture</th><th></th><th>reason and remedy</th></tr>
{% for one in wrong %}
<tr><td>{{ one.name }}</td><td class="{{ one.state }} {{ one.verdict }}">
{{ "warning" if one.state == "done" else words[one.state] }}</td><td>{{ one.message }}</td></tr>
{% endfor %}
</table>
{% endif %}
<div class="sheet">
{% for slug, one in drawn %}
<figure><a href="{{ link(one.report) }}"><img loading="lazy" width="256" height="128" alt=""
 src="{{ link('thumbnails/' ~ slug ~ '.jpg') }}"></a><figcaption>
<span class="{{ one.state }} {{ one.verdict }}">{{ one.name }}</span>
{{ one.title }}{% if one.object_number %} ({{ one.object_number }}){% endif %}

{{ one.verdict }}{% if one.expected_error_deg is not none %}, normals {{ "%.1f" % one.expected_error_deg }}°{% endif %},
{{ "%.1f" % one.seconds }} s, <a href="{{ link(one.asset) }}">GLB</a></figcaption></figure>
{% endfor %}
</div></html>
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
    table.writerows({name: _cell(value) for name, value in row.items()} for row in totals["rows"])
    atomic.write_json(batch_folder / "summary.json", totals)
    atomic.write(batch_folder / "summary.csv", text.getvalue())
    atomic.write(batch_folder / "summary.html", _page(totals, units, records))


def _cell(value: Any) -> Any:
    """A value for a CSV table; text that a spreadsheet would compute gets an apostrophe in front."""
    return f"'{value}" if isinstance(value, str) and value.lstrip(" ").startswith(_FORMULA) else value


def _page(totals: dict[str, Any], units: Sequence[Unit], records: Sequence[UnitRecord]) -> str:
    """The page summary.html: counts, captures with an error, a failed gate or a warning, a picture of each result."""
    import jinja2  # not needed by most commands

    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True).from_string(_PAGE)
    pairs = zip(units, records, strict=True)
    return page.render(
        **totals | {"states": ", ".join(f"{count} {WORDS[state]}" for state, count in totals["states"].items())},
        folder=FOLDER,
        wrong=[record for record in records if record.state != "done" or record.verdict == "warn"],
        drawn=[(unit.slug, record) for unit, record in pairs if unit.thumbnail_file.exists()],
        words=WORDS,
        link=_link,
    )


def _link(path: str) -> str:
    """Address of a file on the page; it never leads to another server."""
    return "./" + addresses.of_file(path)
