"""Polygons and paths of what pictures are made of, as NumPy arrays."""

from collections.abc import Sequence

import numpy as np


def as_quadrilaterals(
    points: np.ndarray, polygons: Sequence[np.ndarray], longest: float
) -> np.ndarray:
    """Polygons in space as quadrilaterals with sides of at most a length, `(n, 4, 3)`.

    Pictures order polygons by the depth of their middles, so large ones must be divided. A
    triangle is a quadrilateral whose last two corners coincide.
    """
    quads = []
    for polygon in polygons:
        corners = points[polygon]
        for k in range(1, len(corners) - 1, 2):
            last = corners[min(k + 2, len(corners) - 1)]
            quads.append([corners[0], corners[k], corners[k + 1], last])
    found = np.array(quads).reshape(-1, 4, 3)
    return _divided(_divided(found, longest), longest)


def _divided(quads: np.ndarray, longest: float) -> np.ndarray:
    """Quadrilaterals divided along their first side, and turned by a corner."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    length = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - d, axis=1))
    counts = np.clip(np.ceil(length / longest).astype(int), 1, 12)
    out = []
    for count in np.unique(counts):
        chosen = counts == count
        s = np.linspace(0, 1, count + 1)[:, None, None]
        low, high = (x[chosen] + s * (y - x)[chosen] for x, y in ((a, b), (d, c)))
        parts = np.stack([low[1:], high[1:], high[:-1], low[:-1]], axis=2)
        out.append(parts.reshape(-1, 4, 3))
    return np.concatenate(out) if out else quads


def normals(quads: np.ndarray) -> np.ndarray:
    """Unit normals of quadrilaterals, by their diagonals."""
    across = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    size = np.linalg.norm(across, axis=1, keepdims=True)
    return across / np.where(size > 0, size, 1)


def across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that are perpendicular to a unit vector in space."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first = first / np.linalg.norm(first)
    return first, np.cross(direction, first)


def line_frame(start: np.ndarray, end: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The length and the direction of a line, and a direction across it.

    Both directions are arbitrary where the ends coincide.
    """
    along = end - start
    length = float(np.linalg.norm(along))
    unit = along / length if length > 0 else np.eye(len(along))[0]
    if len(along) == 2:
        return length, unit, np.array([-unit[1], unit[0]])
    return length, unit, across(unit)[0]


def zigzag(start: np.ndarray, end: np.ndarray, width: float, turns: int = 7) -> np.ndarray:
    """The path of a spring in the plane, straight at its ends."""
    _, _, side = line_frame(start, end)
    s = np.concatenate([[0.0], np.linspace(0.15, 0.85, 2 * turns + 1), [1.0]])
    swing = np.zeros(s.size)
    swing[2:-2] = width * np.where(np.arange(2 * turns - 1) % 2 == 0, 1, -1)
    return start + s[:, None] * (end - start) + swing[:, None] * side


def helix(start: np.ndarray, end: np.ndarray, radius: float, turns: int = 7) -> np.ndarray:
    """The path of a spring in space, straight at its ends."""
    _, unit, first = line_frame(start, end)
    second = np.cross(unit, first)
    s = np.linspace(0.12, 0.88, 10 * turns + 1)
    phase = 2 * np.pi * turns * (s - s[0]) / (s[-1] - s[0])
    coil = np.cos(phase)[:, None] * first + np.sin(phase)[:, None] * second
    inner = start + s[:, None] * (end - start) + radius * coil
    return np.concatenate([start[None], inner, end[None]])


def tube(path: np.ndarray, radius: float, sides: int = 6) -> np.ndarray:
    """Quadrilaterals around a path in space, `(n, 4, 3)`; the ends are open."""
    steps = np.diff(path, axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > 0] if len(path) > 1 else steps
    if len(steps) == 0:
        return np.zeros((0, 4, 3))
    path = np.concatenate([path[:1], path[:1] + np.cumsum(steps, axis=0)])
    units = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    sums = units[1:] + units[:-1]
    sizes = np.linalg.norm(sums, axis=1, keepdims=True)
    # Where a path turns back on itself, the ring belongs to the way there.
    bends = np.where(sizes > 1e-6, sums / np.where(sizes > 1e-6, sizes, 1), units[:-1])
    tangents = np.concatenate([units[:1], bends, units[-1:]])
    first = _carried(across(units[0])[0], tangents)
    second = np.cross(tangents, first)
    turn = 2 * np.pi * np.arange(sides)[:, None] / sides
    rings = np.cos(turn) * first[:, None] + np.sin(turn) * second[:, None]
    rings = path[:, None] + radius * rings
    low, high = rings[:-1], rings[1:]
    quads = [low, np.roll(low, -1, axis=1), np.roll(high, -1, axis=1), high]
    return np.stack(quads, axis=2).reshape(-1, 4, 3)


def _carried(first: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """A direction across a path, carried along it without twist, shape `(n, 3)`."""
    a, b, c = first.tolist()  # plain numbers: a loop over small arrays is slow
    found = []
    for x, y, z in tangents.tolist():
        along = a * x + b * y + c * z
        a, b, c = a - along * x, b - along * y, c - along * z
        size = (a * a + b * b + c * c) ** 0.5
        if size < 1e-6:
            a, b, c = across(np.array([x, y, z]))[0].tolist()
            size = 1.0
        a, b, c = a / size, b / size, c / size
        found.append((a, b, c))
    return np.array(found)


def straight(start: np.ndarray, end: np.ndarray, longest: float) -> np.ndarray:
    """A straight path in pieces of at most a length."""
    count = max(1, int(np.ceil(np.linalg.norm(end - start) / longest)))
    s = np.linspace(0, 1, min(count, 40) + 1)[:, None]
    return start + s * (end - start)


def ball(radius: float, sides: int = 10) -> np.ndarray:
    """Quadrilaterals of a sphere about the origin, `(n, 4, 3)`."""
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    rise = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)[:, None]
    grid = radius * np.stack(
        [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise + 0 * turn)],
        axis=-1,
    )
    quads = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]
    return np.stack(quads, axis=2).reshape(-1, 4, 3)
