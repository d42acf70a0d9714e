"""Random flat and sharp-edged meshes for training: slabs with relief, coins, tiles, sheets, boxes, books, cans.

Their front is +z. A surface that faces the camera polarizes light weakly, and a straight edge is no occluding contour.
So the network has to learn them from shading, and from the falloff of the flash across a plane.
"""

from collections.abc import Callable
from math import cos, pi, radians

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from polcap.image_values import Floats
from polcap.optics.mesh_tracer import Triangles, centred, smooth, union
from polcap.training import random_shapes
from polcap.training.random_shapes import log_uniform

_SIDE = 121  # vertices along a side of a face
_FACING, _TILTED = (0.0, 12.0), (12.0, 70.0)  # deg, angle between front and camera
_SHARES = (0.4, 0.4)  # of views with such an angle; the others are from random sides


def compose(rng: np.random.Generator) -> Triangles:
    """A random flat or sharp-edged mesh with its front at +z, longest side 1, centered."""
    return centred(_KINDS[rng.integers(len(_KINDS))](rng))


def rotation(rng: np.random.Generator) -> Floats:
    """Rotation matrix (3, 3) to a random view: often of the front, facing or tilted; every second one upright."""
    kind = rng.random()
    if kind > sum(_SHARES):
        return random_shapes.rotation(rng)
    tilt = radians(rng.uniform(*(_FACING if kind < _SHARES[0] else _TILTED)))
    axis, spin = rng.uniform(0, 2 * pi), rng.uniform(0, 2 * pi)
    upright = rng.choice([0, pi / 2, pi, 3 * pi / 2]) + radians(rng.normal(0, 3))
    about_front = Rotation.from_rotvec([0, 0, spin if rng.random() < 0.5 else upright])
    return np.asarray((Rotation.from_rotvec([tilt * np.cos(axis), tilt * np.sin(axis), 0]) * about_front).as_matrix())


def _slab(rng: np.random.Generator) -> Triangles:
    """A plate, painting, carving or piece of leather: a rectangle with relief on its front."""
    x, y = _rectangle(rng.uniform(0.4, 1))
    return _solid(x, y, _relief(rng), log_uniform(0.01, 0.12, rng))


def _coin(rng: np.random.Generator) -> Triangles:
    """A coin, medal or lid: a disc or polygon with an embossed front, often with a rim."""
    x, y, radius = _disc(rng, polygon=0.2)
    inner, rim = rng.uniform(0.7, 0.95), rng.choice([-1, 0, 1, 1]) * rng.uniform(0.005, 0.03)
    ramp = np.clip((radius - inner) / rng.uniform(0.01, 0.05), 0, 1)  # 1 on the rim
    relief = (_embossed(rng) if rng.random() < 0.7 else _relief(rng)) * (1 - ramp)
    return _solid(x, y, relief + rim * ramp, log_uniform(0.03, 0.15, rng))


def _tile(rng: np.random.Generator) -> Triangles:
    """A tile, keypad or bar of chocolate: a rectangle divided by grooves into fields with beveled edges."""
    across, along = rng.integers(1, 6, 2)
    x, y = _rectangle(along / across if 0.5 <= along / across <= 1 else rng.uniform(0.5, 1))
    unit = np.linspace(0, 1, _SIDE)
    to_edge = [np.abs((unit * count + 0.5) % 1 - 0.5) / count for count in (across, along)]
    to_groove = np.minimum(to_edge[0][None, :], to_edge[1][:, None])
    width = rng.uniform(0.01, 0.2) / max(across, along)
    bevel = np.clip(to_groove / width, 0, 1)
    bevel = bevel if rng.random() < 0.5 else np.sqrt(1 - (1 - bevel) ** 2)  # straight or round
    steps = rng.normal(size=(along, across)) * rng.choice([0, 0.01])  # fields of unequal height
    column, row = (np.minimum((unit * count).astype(int), count - 1) for count in (across, along))
    field = steps[row[:, None], column[None, :]]
    relief = 0.3 * _relief(rng) if rng.random() < 0.4 else 0.0
    return _solid(x, y, width * rng.uniform(0.3, 1.2) * bevel + field + relief, log_uniform(0.03, 0.2, rng))


def _sheet(rng: np.random.Generator) -> Triangles:
    """A sheet of paper, foil or cloth: thin, crumpled along straight folds, or wavy."""
    x, y = _rectangle(rng.uniform(0.5, 1))
    if rng.random() < 0.6:
        height = np.zeros_like(x)
        for _ in range(int(rng.integers(1, 14))):
            turn, offset = rng.uniform(0, 2 * pi), rng.uniform(-0.45, 0.45)
            height += rng.normal() * np.abs(np.cos(turn) * x + np.sin(turn) * y - offset)
        height *= rng.uniform(0.05, 0.6) / (np.abs(height).max() + 1e-6) * 0.5
        height += 0.3 * _relief(rng)
    else:
        height = _waves(log_uniform(0.05, 0.4, rng), rng) * log_uniform(0.01, 0.12, rng)
    return _solid(x, y, height, 0.006, bent=True)


def _box(rng: np.random.Generator) -> Triangles:
    """A box with sharp or beveled edges, or a prism."""
    thickness = log_uniform(0.15, 1.2, rng)
    x, y = _rectangle(rng.uniform(0.3, 1)) if rng.random() < 0.8 else _disc(rng, polygon=1.0)[:2]
    height = _rounding(rng.uniform(0.005, 0.05)) if rng.random() < 0.4 else np.zeros_like(x)
    return _solid(x, y, height, thickness)


def _book(rng: np.random.Generator) -> Triangles:
    """A closed book: two covers, a block of pages between them, a spine."""
    depth, tall = log_uniform(0.04, 0.3, rng), rng.uniform(0.6, 0.8)
    cover, inset = rng.uniform(0.006, 0.02), rng.uniform(0.005, 0.03)
    embossed = _embossed(rng) * rng.uniform(0, 0.5)
    groove = -rng.uniform(0, 0.01) * np.exp(-((np.linspace(0, 1, _SIDE)[None] - 0.06) ** 2) / 2e-4)
    x, y = _rectangle(tall)
    front = _solid(x, y, embossed + groove, cover)
    back = front.vertices * [1, -1, -1] - [0, 0, cover + depth]
    pages = (1 - inset) * np.stack([x, y]) - np.array([inset, 0])[:, None, None]
    block = _solid(pages[0], pages[1], np.full_like(x, -cover / 2), depth + cover)
    spine = _solid(0.5 * cover * (2 * x) - 0.5, y, np.zeros_like(x), 2 * cover + depth)
    return union([front, smooth(back, front.faces), block, spine])


def _can(rng: np.random.Generator) -> Triangles:
    """A can, jar, roll or puck: a cylinder with a rim at its top, and sometimes ribs around it."""
    x, y, radius = _disc(rng, polygon=0.0)
    inner, deep = rng.uniform(0.8, 0.97), rng.uniform(0, 0.06)
    top = -deep * np.clip((inner - radius) / 0.02, 0, 1) + rng.uniform(0, 0.02) * np.cos(rng.uniform(0, 40) * radius)
    body = _solid(x, y, top, log_uniform(0.3, 2.2, rng))
    if rng.random() < 0.6:
        return body
    low, high = body.vertices[:, 2].min(), body.vertices[:, 2].max()
    bands = [_solid(1.02 * x, 1.02 * y, np.full_like(x, at), rng.uniform(0.01, 0.05)) for at in (high, low + 0.04)]
    return union([body, *bands])


def _stack(rng: np.random.Generator) -> Triangles:
    """Two to five flat things on each other, turned and shifted: stairs, bricks, books, coins."""
    parts, level = [], 0.0
    for _ in range(int(rng.integers(2, 6))):
        part = compose(rng)
        size = rng.uniform(0.5, 1)
        turn = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * pi)]).as_matrix()
        vertices = size * part.vertices @ turn.T
        vertices += [*rng.normal(0, 0.12, 2), level - vertices[:, 2].max()]
        level = float(vertices[:, 2].min()) + 1e-3
        parts.append(smooth(vertices, part.faces))
    return union(parts)


_KINDS: list[Callable[[np.random.Generator], Triangles]] = [
    _slab, _slab, _slab, _coin, _coin, _tile, _sheet, _sheet, _box, _box, _book, _can, _stack,
]  # fmt: skip


def _solid(x: Floats, y: Floats, top: Floats, thickness: float, *, bent: bool = False) -> Triangles:
    """Closed mesh between a front at height `top` and a flat back; x, y and top are (N, N), edges are sharp.

    The back is `thickness` below the lowest edge of the front. With `bent`, it has the front's shape.
    """
    low = top - thickness if bent else np.full_like(top, min(top.min(), 0.0) - thickness)
    front, back = (np.stack([x, y, z], axis=-1) for z in (top, low))
    count = len(x)
    n = np.arange(count * count).reshape(count, count)
    a, b, c, d = n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]  # counter-clockwise: columns are x, rows are y
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    border = np.concatenate([n[0, :-1], n[:-1, -1], n[-1, :0:-1], n[:0:-1, 0]])
    wall = np.concatenate([front.reshape(-1, 3)[border], back.reshape(-1, 3)[border]])
    sides = random_shapes.ring_faces(2, len(border), closed=False)
    return union(
        [smooth(front.reshape(-1, 3), faces), smooth(back.reshape(-1, 3), faces[:, ::-1]), smooth(wall, sides)]
    )


def _rectangle(aspect: float) -> tuple[Floats, Floats]:
    """Grid x, y (N, N) of a rectangle with the sides 1 and `aspect`."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, _SIDE), aspect * np.linspace(-0.5, 0.5, _SIDE))
    return x, y


def _disc(rng: np.random.Generator, polygon: float) -> tuple[Floats, Floats, Floats]:
    """Grid x, y (N, N) of a disc of diameter 1, or with the probability `polygon` of a regular polygon; radius 0…1.

    References
    ----------
    Shirley & Chiu, A low distortion map between disk and square, 1997.
    """
    a, b = np.meshgrid(np.linspace(-1, 1, _SIDE), np.linspace(-1, 1, _SIDE))
    radius = np.maximum(np.abs(a), np.abs(b))
    wide = np.abs(a) > np.abs(b)
    ratio = np.where(wide, b, a) / np.maximum(radius, 1e-9) * np.where(wide, np.sign(a), np.sign(b))
    angle = np.where(wide, pi / 4 * ratio, pi / 2 - pi / 4 * ratio) + np.where(np.where(wide, a, b) < 0, pi, 0)
    edge = np.full_like(radius, 0.5)
    if rng.random() < polygon:
        sector = 2 * pi / rng.integers(3, 9)
        edge = 0.5 * cos(sector / 2) / np.cos((angle + 0.01) % sector - sector / 2)
    return edge * radius * np.cos(angle), edge * radius * np.sin(angle), radius


def _relief(rng: np.random.Generator) -> Floats:
    """Random relief (N, N), in sides of the face: none, waves, strokes, embossed, stamped, or a sum of two of these."""
    kinds: list[Callable[[np.random.Generator], Floats]] = [_flat, _hills, _hills, _strokes, _embossed, _stamped]
    first, second = (kinds[k](rng) for k in rng.integers(len(kinds), size=2))
    return np.asarray(first + second * (rng.random() < 0.3))


def _flat(rng: np.random.Generator) -> Floats:
    """No relief, but a slight bow of the whole face."""
    unit = np.linspace(-1, 1, _SIDE)
    return rng.normal(0, 0.01) * unit[None] ** 2 + rng.normal(0, 0.01) * unit[:, None] ** 2


def _hills(rng: np.random.Generator) -> Floats:
    """Waves of one to three lengths with slopes of 1 to 20°."""
    longest = log_uniform(0.02, 0.3, rng)
    total = sum((_waves(longest * 0.5**k, rng) * 0.6**k for k in range(int(rng.integers(1, 4)))), np.zeros(()))
    return _with_slope(np.asarray(total), log_uniform(0.02, 0.35, rng))


def _strokes(rng: np.random.Generator) -> Floats:
    """Brush strokes, grain or weave: waves that are long in one direction."""
    short, long = log_uniform(0.008, 0.03, rng), log_uniform(0.05, 0.5, rng)
    height = _field((short, long), rng)
    if rng.random() < 0.4:
        height = height + _field((long, short), rng)
    return _with_slope(height, log_uniform(0.02, 0.3, rng))


def _embossed(rng: np.random.Generator) -> Floats:
    """Two levels with a flank between them, and modelling on the raised one: the image of a coin or a book's cover."""
    form = np.tanh(rng.uniform(1, 12) * (_waves(log_uniform(0.04, 0.2, rng), rng) + rng.normal(0, 0.5)))
    modelled = 1 + rng.uniform(0, 0.5) * _waves(0.05, rng)
    return _with_slope(form * modelled, log_uniform(0.03, 0.3, rng))


def _stamped(rng: np.random.Generator) -> Floats:
    """Raised or sunk bars and discs: letters, buttons, frames, rivets."""
    x, y = _rectangle(1.0)
    height = np.zeros_like(x)
    depth = log_uniform(0.003, 0.03, rng)
    for _ in range(int(rng.integers(1, 25))):
        u, v = x - rng.uniform(-0.45, 0.45), y - rng.uniform(-0.45, 0.45)
        wide, tall = log_uniform(0.01, 0.25, rng, 2)
        inside = (
            (u / wide) ** 2 + (v / tall) ** 2 < 1 if rng.random() < 0.4 else (np.abs(u) < wide) & (np.abs(v) < tall)
        )
        height = np.where(inside, rng.choice([-1, 1, 1]) * depth, height)
    return np.asarray(gaussian_filter(height, rng.uniform(0.5, 2)))


def _waves(length: float, rng: np.random.Generator) -> Floats:
    """A random field (N, N) of standard deviation 1 with waves of about this length, in sides of the face."""
    return _field((length / 3, length / 3), rng)


def _field(width: tuple[float, float], rng: np.random.Generator) -> Floats:
    """White noise blurred with Gaussians of these widths along y and x, in sides of the face; standard deviation 1."""
    noise = gaussian_filter(rng.normal(size=(_SIDE, _SIDE)), [w * _SIDE for w in width], mode="wrap")
    return np.asarray((noise - noise.mean()) / (noise.std() + 1e-12))


def _with_slope(height: Floats, slope: float) -> Floats:
    """Relief scaled to this root mean square of its slopes; the face has the side 1."""
    steep = np.sqrt(np.mean(np.square(np.gradient(height, 1 / (_SIDE - 1))).sum(axis=0)))
    return np.asarray(height * slope / max(float(steep), 1e-9))


def _rounding(radius: float) -> Floats:
    """Height (N, N) of a face whose edges are rounded with this radius, in sides of the face."""
    unit = np.linspace(0, 1, _SIDE)
    to_edge = np.minimum(unit, 1 - unit)
    short = np.clip(radius - np.minimum(to_edge[None], to_edge[:, None]), 0, radius)
    return np.asarray(np.sqrt(radius**2 - short**2) - radius)
