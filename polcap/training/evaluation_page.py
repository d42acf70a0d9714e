"""Page of the evaluation's figures, with the published ones: evaluation.md."""

from collections.abc import Mapping, Sequence
from typing import Any

# Deschaintre, Lin & Ghosh, CVPR 2021, tables 1 and 2, on the authors' own test set
_FIGURES = ("normal_mean", "diffuse", "roughness", "specular", "depth", "rendering")
_PAPER = {"paper": dict(zip(_FIGURES, (12.00, 0.0382, 0.113, 0.0293, 0.174, 0.024)))}
PUBLISHED = _PAPER | {
    "Li 2018": {"normal_mean": 42.23, "depth": 0.339, "rendering": 0.103},
    "Boss 2020": {"normal_mean": 47.69, "depth": 0.327, "rendering": 0.185},
}
PUBLISHED_ABLATIONS = _PAPER | {
    "paper (a), plain skips": dict(zip(_FIGURES, (14.17, 0.05, 0.115, 0.07, 0.176, 0.0285))),
    "paper (b), unpolarized loss": dict(zip(_FIGURES, (12.38, 0.087, 0.131, 0.0339, 0.196, 0.0351))),
    "paper (c), no polarization": dict(zip(_FIGURES, (24.14, 0.0783, 0.155, 0.0555, 0.223, 0.0485))),
}


def _row_names() -> dict[str, str]:
    """Names of the table's rows by the name of their figure."""
    names: dict[str, str] = {}
    for end, core in (("", ""), ("_core", ", eroded mask")):
        names |= {f"normal_{kind}{end}": f"normal, {kind}{core} [°]" for kind in ("mean", "median")}
        names |= {
            f"normal_within_{limit}{end}": f"normal under {limit}°{core} [%]" for limit in ("11.25", "22.5", "30")
        }
    errors = {"": "RMSE", "_l1": "L1", "_picture": "RMSE, whole picture", "_l1_picture": "L1, whole picture"}
    for image in ("diffuse", "roughness", "specular", "rendering"):
        names |= {image + end: f"{image} {name}" for end, name in errors.items()}
        if image == "diffuse":
            names["diffuse_clipped"] = "diffuse RMSE in clipped highlights"
        if image == "specular":
            names["depth"] = "depth RMSE"
            names["depth_fitted"] = "depth RMSE, scale and shift fitted"
            names["depth_integrated"] = "depth RMSE after integration"
    return names


ROWS = _row_names()
_AVERAGED = (
    "RMSE is the root of the mean square over a picture's masked pixels and channels (for renderings over the 20 "
    "lights too); each figure is the mean of all pictures, as the paper's tables suggest. Depth is the estimated map, "
    "centered within the mask and divided by the truth's range, without a fitted scale; after integration: the surface "
    "of stage 9 from the normals and this map, at about 128 px. Renderings are linear and clipped to 0…1, where 1 is "
    "the 99th percentile of the truth under the flash; refractive index 1.5, no cast shadows. The eroded mask is 2 px "
    "thinner. Over the whole picture the error outside the object is zero: RMSE times the root of the object's share "
    "of the picture, L1 times the share. The paper's text mentions L1, its captions RMSE, and neither names the area; "
    "its figures are in the first row of each."
)
Table = Mapping[str, Mapping[str, float]]


def make_page(result: Mapping[str, Any]) -> str:
    """Markdown of evaluation.json's content."""
    conditions = result["conditions"]
    ratios = [f"{name} {value:.2f}" for name, value in result["of_mean_maps"].items()]
    parts = [
        f"# Evaluation: {conditions['pictures']} pictures at {conditions['size']}²",
        f"6 test meshes × 30 test materials, protocol {conditions['protocol']} ({conditions['materials']}). "
        f"Model {conditions['model'][:12]} {conditions['version']}. Camera: {conditions['camera']}.",
        f"Standard deviation of the truth's F0 over all pictures: {conditions['f0_deviation']:.3f}.",
        _table(result["table"], PUBLISHED),
        _AVERAGED,
        "*As published*: on the authors' test set, which is not public, so the columns cannot be compared directly.",
        f"RMSE of ours divided by that of the best constant map: {', '.join(ratios)}.",
    ]
    if result["ablations"]:
        parts += [
            "## Networks alone, at one reduced budget",
            "Each sees the picture binned to about the size of training. Its maps are enlarged, without inversion.",
            _table(result["ablations"], PUBLISHED_ABLATIONS),
        ]
    tenths = [
        [str(k + 1), *(f"{n:.2f}" for n in (r["predicted"], r["actual"], r["predicted"] / max(r["actual"], 1e-6)))]
        for k, r in enumerate(result["calibration"])
    ]
    parts += [
        "## Expected normal error, by tenths of the pixels",
        grid(["tenth", "predicted [°]", "actual [°]", "predicted / actual"], tenths),
        "## Cost",
        grid(["", "s per picture"], [[name, f"{value:.2f}"] for name, value in result["seconds"].items()]),
    ]
    return "\n\n".join(parts) + "\n"


def _table(columns: Table, published: Table) -> str:
    columns = {**columns, **{f"{name} *(as published)*": figures for name, figures in published.items()}}
    rows = [key for key in ROWS if any(key in figures for figures in columns.values())]
    return grid(["", *columns], [[ROWS[key], *(_cell(key, c.get(key)) for c in columns.values())] for key in rows])


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return "–"
    if "within" in key:
        return f"{100 * value:.1f}"
    return f"{value:.2f}" if key.startswith("normal") else f"{value:.4f}"


def grid(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Markdown table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body))
