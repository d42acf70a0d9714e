"""Page of the evaluation's figures, with the published ones: evaluation.md."""

from collections.abc import Mapping, Sequence
from typing import Any

# Deschaintre, Lin & Ghosh, CVPR 2021, tables 1 and 2, on the authors' own test set
PUBLISHED = {
    "paper": {
        "normal_mean": 12.00, "diffuse": 0.0382, "roughness": 0.113, "specular": 0.0293, "depth": 0.174,
        "rendering": 0.024,
    },
    "Li 2018": {"normal_mean": 42.23, "depth": 0.339, "rendering": 0.103},
    "Boss 2020": {"normal_mean": 47.69, "depth": 0.327, "rendering": 0.185},
}  # fmt: skip
PUBLISHED_ABLATIONS = {
    "paper": PUBLISHED["paper"],
    "paper (a), plain skips": {
        "normal_mean": 14.17, "diffuse": 0.05, "roughness": 0.115, "specular": 0.07, "depth": 0.176,
        "rendering": 0.0285,
    },
    "paper (b), unpolarized loss": {
        "normal_mean": 12.38, "diffuse": 0.087, "roughness": 0.131, "specular": 0.0339, "depth": 0.196,
        "rendering": 0.0351,
    },
    "paper (c), no polarization": {
        "normal_mean": 24.14, "diffuse": 0.0783, "roughness": 0.155, "specular": 0.0555, "depth": 0.223,
        "rendering": 0.0485,
    },
}  # fmt: skip
ROWS = {
    "normal_mean": "normal, mean [°]",
    "normal_median": "normal, median [°]",
    "normal_within_11.25": "normal under 11.25° [%]",
    "normal_within_22.5": "normal under 22.5° [%]",
    "normal_within_30": "normal under 30° [%]",
    "normal_mean_core": "normal, mean, eroded mask [°]",
    "normal_median_core": "normal, median, eroded mask [°]",
    "normal_within_11.25_core": "normal under 11.25°, eroded mask [%]",
    "normal_within_22.5_core": "normal under 22.5°, eroded mask [%]",
    "normal_within_30_core": "normal under 30°, eroded mask [%]",
    "diffuse": "diffuse RMSE",
    "diffuse_l1": "diffuse L1",
    "diffuse_picture": "diffuse RMSE, whole picture",
    "diffuse_l1_picture": "diffuse L1, whole picture",
    "diffuse_clipped": "diffuse RMSE in clipped highlights",
    "roughness": "roughness RMSE",
    "roughness_l1": "roughness L1",
    "roughness_picture": "roughness RMSE, whole picture",
    "roughness_l1_picture": "roughness L1, whole picture",
    "specular": "specular RMSE",
    "specular_l1": "specular L1",
    "specular_picture": "specular RMSE, whole picture",
    "specular_l1_picture": "specular L1, whole picture",
    "depth": "depth RMSE",
    "depth_fitted": "depth RMSE, scale and shift fitted",
    "depth_integrated": "depth RMSE after integration",
    "rendering": "rendering RMSE",
    "rendering_l1": "rendering L1",
    "rendering_picture": "rendering RMSE, whole picture",
    "rendering_l1_picture": "rendering L1, whole picture",
}
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
    main = {**result["table"], **_published(PUBLISHED)}
    parts = [
        f"# Evaluation: {conditions['pictures']} pictures at {conditions['size']}²",
        f"6 test meshes × 30 test materials, protocol {conditions['protocol']} ({conditions['materials']}). "
        f"Model {conditions['model'][:12]} {conditions['version']}. Camera: {conditions['camera']}.",
        f"Standard deviation of the truth's F0 over all pictures: {conditions['f0_deviation']:.3f}.",
        _table(main),
        _AVERAGED,
        "*As published*: on the authors' test set, which is not public, so the columns cannot be compared directly.",
    ]
    ratios = [f"{name} {value:.2f}" for name, value in result["of_mean_maps"].items()]
    parts.append(f"RMSE of ours divided by that of the best constant map: {', '.join(ratios)}.")
    if result["ablations"]:
        parts += [
            "## Networks alone, at one reduced budget",
            "Each sees the picture binned to about the size of training. Its maps are enlarged, without inversion.",
            _table({**result["ablations"], **_published(PUBLISHED_ABLATIONS)}),
        ]
    parts += ["## Expected normal error, by tenths of the pixels", _calibration(result["calibration"])]
    parts += ["## Cost", _cost(result["seconds"])]
    return "\n\n".join(parts) + "\n"


def _published(table: Table) -> dict[str, Mapping[str, float]]:
    return {f"{name} *(as published)*": figures for name, figures in table.items()}


def _table(columns: Table) -> str:
    rows = [key for key in ROWS if any(key in figures for figures in columns.values())]
    return _grid(["", *columns], [[ROWS[key], *(_cell(key, c.get(key)) for c in columns.values())] for key in rows])


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return "–"
    if "within" in key:
        return f"{100 * value:.1f}"
    return f"{value:.2f}" if key.startswith("normal") else f"{value:.4f}"


def _calibration(rows: Sequence[Mapping[str, float]]) -> str:
    body = [
        [str(k + 1), f"{r['predicted']:.2f}", f"{r['actual']:.2f}", f"{r['predicted'] / max(r['actual'], 1e-6):.2f}"]
        for k, r in enumerate(rows)
    ]
    return _grid(["tenth", "predicted [°]", "actual [°]", "predicted / actual"], body)


def _cost(seconds: Mapping[str, float]) -> str:
    return _grid(["", "s per picture"], [[name, f"{value:.2f}"] for name, value in seconds.items()])


def _grid(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
