"""Writes pictures as static IIIF files (tiles and a manifest), which any web server can publish.

References
----------
IIIF Image API 3.0, §5 and compliance level 0; IIIF Presentation API 3.0.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from polcap.errors import SettingError
from polcap.formats import addresses, atomic
from polcap.formats.export import encoders
from polcap.formats.export.texture_set import Texture
from polcap.image_values import TexturePixels
from polcap.optics.resize import area_mean

TILE = 512  # px of a tile's sides
FULL = "full/max/0/default.jpg"  # the whole picture, below the address of its service
_RIGHTS = ("creativecommons.org/", "rightsstatements.org/")  # the addresses that a manifest's `rights` may hold
_LABELS = {  # Dublin Core
    "creator": "Creator", "license": "License", "object_number": "Identifier", "date": "Date",
    "institution": "Institution",
}  # fmt: skip


def check(address: str) -> None:
    """Raise a SettingError for an address that is not a web address (http or https)."""
    if not address.startswith(("http://", "https://")):
        raise SettingError(
            f"--iiif {address} is no web address; give that of the folder, such as http://localhost:8000"
        )


def write(folder: Path, pictures: Mapping[str, Texture], facts: Mapping[str, str], address: str) -> list[Path]:
    """Write tiles, descriptions and manifest of pictures that will be served at `address`.

    `facts` are fields of `CatalogEntry` and the capture's `name`. Returns the manifest, the descriptions and the whole
    pictures; tiles are parts of these.
    """
    address = addresses.of_web(address).rstrip("/")
    written = [folder / "manifest.json"]
    for name, picture in pictures.items():
        for place, part in _images(picture.pixels):
            one = Texture(part, picture.color, picture.meaning)
            atomic.write(folder / name / place, encoders.encode(one, "jpeg"), synced=False)
        described = folder / name / "info.json"
        height, width = picture.pixels.shape[:2]
        atomic.write_json(described, image_information(f"{address}/{name}", width, height))
        written += [described, folder / name / FULL]
    atomic.write_json(written[0], manifest(pictures, facts, address))
    return written


def image_information(service: str, width: int, height: int) -> dict[str, Any]:
    """The IIIF image information of a picture of this size [px]; `service` is the address of its tiles."""
    factors = _scale_factors(width, height)
    return {
        "@context": "http://iiif.io/api/image/3/context.json",
        "id": service,
        "type": "ImageService3",
        "protocol": "http://iiif.io/api/image",
        "profile": "level0",
        "width": width,
        "height": height,
        "sizes": [{"width": -(-width // factors[-1]), "height": -(-height // factors[-1])}],
        "tiles": [{"width": TILE, "height": TILE, "scaleFactors": factors}],
    }


def manifest(pictures: Mapping[str, Texture], facts: Mapping[str, str], address: str) -> dict[str, Any]:
    """The IIIF manifest: a canvas for each picture, and the facts of the catalog."""
    license_ = facts.get("license", "")
    rights_address = license_.partition("://")[2].removeprefix("www.")
    stated = {key: facts[key] for key in _LABELS if facts.get(key)}
    notice = {"label": _text("Rights", "en"), "value": _text(facts["rights"])} if facts.get("rights") else None
    keys: dict[str, Any] = {
        "@context": "http://iiif.io/api/presentation/3/context.json",
        "id": f"{address}/manifest.json",
        "type": "Manifest",
        "label": _text(facts.get("title") or facts["name"]),
        "summary": _text(facts["description"]) if facts.get("description") else None,
        "metadata": [{"label": _text(_LABELS[key], "en"), "value": _text(value)} for key, value in stated.items()],
        "rights": addresses.of_web(f"http://{rights_address}") if rights_address.startswith(_RIGHTS) else None,
        "requiredStatement": notice,
        "items": [_canvas(name, picture, address) for name, picture in pictures.items()],
    }
    return {key: value for key, value in keys.items() if value is not None}


def _canvas(name: str, picture: Texture, address: str) -> dict[str, Any]:
    """The canvas of one picture in the manifest, with its tiles at `address`."""
    canvas, service = f"{address}/canvas/{name}", f"{address}/{name}"
    height, width = picture.pixels.shape[:2]
    size = {"width": width, "height": height}
    image = {
        "id": f"{service}/{FULL}",
        "type": "Image",
        "format": "image/jpeg",
        **size,
        "service": [{"id": service, "type": "ImageService3", "profile": "level0"}],
    }
    annotation = {
        "id": f"{canvas}/annotation",
        "type": "Annotation",
        "motivation": "painting",
        "body": image,
        "target": canvas,
    }
    page = {"id": f"{canvas}/page", "type": "AnnotationPage", "items": [annotation]}
    return {
        "id": canvas,
        "type": "Canvas",
        "label": _text(name, "en"),
        "summary": _text(picture.meaning, "en"),
        **size,
        "items": [page],
    }


def _scale_factors(width: int, height: int) -> list[int]:
    """Reductions of the tiles: powers of two, up to that with which the whole picture fits into one tile."""
    factors = [1]
    while max(width, height) > TILE * factors[-1]:
        factors.append(2 * factors[-1])
    return factors


def _images(pixels: TexturePixels) -> Iterator[tuple[str, TexturePixels]]:
    """Yield all tiles of a picture: path below its address, and pixels.

    Viewers request an image of one tile as `full` or by its region, so it is written under both paths.
    """
    height, width = pixels.shape[:2]
    yield FULL, pixels
    for factor in _scale_factors(width, height):
        reduced = area_mean(pixels, (-(-height // factor), -(-width // factor)))
        for top in range(0, reduced.shape[0], TILE):
            for left in range(0, reduced.shape[1], TILE):
                tile = reduced[top : top + TILE, left : left + TILE]
                x, y = left * factor, top * factor
                region = f"{x},{y},{min(TILE * factor, width - x)},{min(TILE * factor, height - y)}"
                yield f"{region}/{tile.shape[1]},{tile.shape[0]}/0/default.jpg", tile
    yield f"full/{reduced.shape[1]},{reduced.shape[0]}/0/default.jpg", reduced


def _text(words: str, language: str = "none") -> dict[str, list[str]]:
    """A text in the form of the Presentation API: a list by language."""
    return {language: [words]}
