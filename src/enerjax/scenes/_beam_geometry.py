"""The sections of a beam in its reference, from two points or from a curve."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._programs import is_known, module_of
from ._arguments import direction, number


# Points of a curve per element, at which its length and its directions are found.
_FINE = 64
# The largest angle, in degrees, by which an element may turn in the reference.
_LARGEST_TURN = 90.0


class Sections(NamedTuple):
    """The sections of a beam, `n + 1` for `n` elements.

    - `places`: arc lengths, known numbers between 0 and 1, as parts of the whole.
    - `lengths`: of the elements, shape `(n,)`.
    - `origins`: shape `(n + 1, d)`.
    - `axes`: as rows, shape `(n + 1, d, d)`.
    - `angles`: in the plane, shape `(n + 1,)`; else `None`.
    """

    places: np.ndarray
    lengths: Any
    origins: Any
    axes: Any
    angles: Any


def places_of(beam: str, elements: Any) -> np.ndarray:
    """The arc lengths of the sections as parts of the whole."""
    if isinstance(elements, int | np.integer) and not isinstance(elements, bool):
        if elements < 1:
            raise ValueError(f"'{beam}' needs at least one element, got {elements}.")
        return np.linspace(0.0, 1.0, int(elements) + 1)
    told = (
        f"`elements` of '{beam}' must be their number, or the arc lengths of all sections "
        "from start to end as parts of the whole, such as [0, 0.25, 1]"
    )
    if not is_known(elements):
        raise TypeError(f"{told}: known numbers, because they are part of the program.")
    try:
        places = np.asarray(elements, float)
    except (TypeError, ValueError):
        raise TypeError(f"{told}; got {elements!r}.") from None
    if places.ndim != 1 or places.size < 2 or places[0] != 0 or places[-1] != 1:
        raise ValueError(f"{told}; got {elements!r}.")
    if np.diff(places).min() <= 0:
        raise ValueError(f"{told}: they must increase, got {places.tolist()}.")
    return places


def weights_of(places: np.ndarray) -> np.ndarray:
    """The parts of the mass that are in each section.

    They are the weights of a quadrature that is exact for polynomials of degree 2, so the
    mass centre and the moments of inertia of a straight beam are exact, if it has at least
    two elements: the mean of the two parabolas through the ends of an element and the
    section before or after it.
    """
    steps, count = np.diff(places), places.size
    halves = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    if count == 2:
        return halves
    weights = np.zeros(count)
    for k in range(count - 1):
        firsts = [j for j in (k - 1, k) if 0 <= j <= count - 3]
        for j in firsts:
            weights[j : j + 3] += _parabola(places[j : j + 3], k - j) / len(firsts)
    # Where neighbours differ very much in length, a weight could be too small for a mass.
    return weights if np.all(weights > 0.5 * halves) else halves


def _parabola(x: np.ndarray, k: int) -> np.ndarray:
    """The integral from `x[k]` to `x[k + 1]` of the parabola through values at `x`."""
    powers = np.arange(3)
    moments = (x[k + 1] ** (powers + 1) - x[k] ** (powers + 1)) / (powers + 1)
    return np.linalg.solve(x[None] ** powers[:, None], moments)


def straight(beam: str, ends: Any, places: np.ndarray, normal: Any, twist: Any) -> Sections:
    """The sections of a straight beam between two points."""
    start, end = number(f"'{beam}'", "`axis`", ends, (2, 2), (2, 3))
    xp = module_of(start, end)
    along = end - start
    length = xp.sqrt(xp.sum(along**2))
    if is_known(length) and length <= 1e-12 * np.abs([start, end]).max():
        raise ValueError(
            f"The sections of '{beam}' coincide: the two points of its `axis` are the "
            f"same, {start.tolist()}."
        )
    origins = start + places[:, None] * along
    lengths = length * np.diff(places)
    tangents = xp.broadcast_to(along / length, origins.shape)
    if start.size == 2:
        _refuse_in_plane(beam, normal, twist)
        return _in_plane(places, lengths, origins, tangents)
    second = _across(beam, tangents[0], normal)
    seconds = xp.broadcast_to(second, origins.shape)
    return _in_space(beam, places, lengths, origins, tangents, seconds, twist)


def along_curve(
    beam: str,
    curve: Callable[[Any], Any],
    places: np.ndarray,
    normal: Any,
    twist: Any,
) -> Sections:
    """The sections of a beam along a curve `curve(u)`, with `u` between 0 and 1.

    Without a twist the axes turn about the tangent as little as possible.
    """
    count = _FINE * (places.size - 1)
    u = np.linspace(0.0, 1.0, count + 1)
    lengths = _arc_lengths(beam, curve, u)
    total = lengths[-1]
    at = _inverse(beam, curve, u, lengths, places * total)
    origins, slopes = _evaluated(beam, curve, at)
    speeds = np.linalg.norm(slopes, axis=1, keepdims=True)
    tangents = slopes / speeds
    _check_turns(beam, curve, u, lengths, places * total)
    steps = total * np.diff(places)
    if origins.shape[1] == 2:
        _refuse_in_plane(beam, normal, twist)
        return _in_plane(places, steps, origins, tangents)
    seconds = _transported(beam, curve, at, tangents, normal)
    return _in_space(beam, places, steps, origins, tangents, seconds, twist)


def _refuse_in_plane(beam: str, normal: Any, twist: Any) -> None:
    if normal is not None or twist is not None:
        raise ValueError(f"'{beam}' is in the plane, where it has no `normal` or `twist`.")


def _in_plane(places: np.ndarray, lengths: Any, origins: Any, tangents: Any) -> Sections:
    xp = module_of(tangents)
    angles = xp.arctan2(tangents[:, 1], tangents[:, 0])
    if is_known(angles):  # those of a straight beam, which may be traced, are all equal
        angles = np.unwrap(angles)
    normals = xp.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    return Sections(places, lengths, origins, xp.stack([tangents, normals], axis=1), angles)


def _in_space(
    beam: str,
    places: np.ndarray,
    lengths: Any,
    origins: Any,
    tangents: Any,
    seconds: Any,
    twist: Any,
) -> Sections:
    xp = module_of(tangents, seconds)
    thirds = xp.cross(tangents, seconds)
    if twist is not None:
        angles = _twists(beam, twist, places)[:, None]
        xp = module_of(tangents, seconds, angles)
        c, s = xp.cos(angles), xp.sin(angles)
        seconds, thirds = c * seconds + s * thirds, c * thirds - s * seconds
    axes = xp.stack([tangents, seconds, thirds], axis=1)
    return Sections(places, lengths, origins, axes, None)


def _twists(beam: str, twist: Any, places: np.ndarray) -> Any:
    """The angle of twist of each section about the beam."""
    if callable(twist):
        values = [number(f"'{beam}'", "`twist`", twist(float(x)), ()) for x in places]
        return module_of(values).stack(values)
    return number(f"'{beam}'", "`twist`", twist, ()) * places


def _across(beam: str, tangent: Any, normal: Any) -> Any:
    """Axis 2 of a section, across its tangent."""
    xp = module_of(tangent)
    if normal is None:
        # Horizontal, with the third axis upwards, where the beam is not vertical itself.
        upright = np.array([0.0, 0.0, 1.0])
        vertical = xp.abs(tangent[2]) > 1 - 1e-6
        side = xp.where(vertical, np.array([0.0, 1.0, 0.0]), xp.cross(upright, tangent))
    else:
        side = direction(f"'{beam}'", "`normal`", normal, 3)
    xp = module_of(tangent, side)
    across = side - xp.sum(side * tangent) * tangent
    size = xp.sqrt(xp.sum(across**2))
    if is_known(size) and size < 1e-6:
        raise ValueError(
            f"`normal` of '{beam}', the direction of axis 2 of its sections, is along the "
            "beam: it must be across."
        )
    return across / size


def _evaluated(beam: str, curve: Callable, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and slopes of a curve."""
    try:
        points, slopes = jax.vmap(
            lambda x: jax.jvp(lambda x: jnp.asarray(curve(x)) * 1.0, (x,), (1.0,))
        )(jnp.asarray(u))
    except TypeError as error:
        raise TypeError(
            f"`axis` of '{beam}' must be a function of a number between 0 and 1, written "
            f"with `jax.numpy`: {error}"
        ) from None
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(
            f"`axis` of '{beam}' must return a point of two or three entries, got shape "
            f"{points.shape[1:]}."
        )
    if not is_known(points):
        raise ValueError(f"`axis` of '{beam}' must not depend on traced values.")
    points, slopes = np.asarray(points), np.asarray(slopes)
    speeds = np.linalg.norm(slopes, axis=1)
    if not (np.isfinite(points).all() and speeds.min() > 1e-9 * speeds.max()):
        raise ValueError(
            f"`axis` of '{beam}' must be a smooth curve that does not stand still: its "
            "slope vanishes or is not finite, and sections of the beam would coincide."
        )
    return points, slopes


# Gauss's five points and weights on an interval of length one.
_NODES, _WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(5))


def _arc_lengths(beam: str, curve: Callable, u: np.ndarray) -> np.ndarray:
    """The arc length from the start to the parameters `u`."""
    middle, widths = (u[1:] + u[:-1]) / 2, np.diff(u)
    at = middle[:, None] + widths[:, None] * _NODES
    slopes = _evaluated(beam, curve, at.ravel())[1]
    speeds = np.linalg.norm(slopes, axis=1).reshape(at.shape)
    return np.append(0.0, np.cumsum(widths * (speeds @ _WEIGHTS)))


def _inverse(
    beam: str, curve: Callable, u: np.ndarray, lengths: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """The parameters at which the arc length has some values."""
    k = np.clip(np.searchsorted(lengths, wanted) - 1, 0, u.size - 2)
    first, missing = u[k], wanted - lengths[k]
    at = first + missing / (lengths[k + 1] - lengths[k]) * (u[k + 1] - u[k])
    for _ in range(4):  # Newton's method
        widths = at - first
        nodes = first[:, None] + widths[:, None] * (_NODES + 0.5)
        slopes = _evaluated(beam, curve, nodes.ravel())[1]
        speeds = np.linalg.norm(slopes, axis=1).reshape(nodes.shape)
        here = np.linalg.norm(_evaluated(beam, curve, at)[1], axis=1)
        at = at - (widths * (speeds @ _WEIGHTS) - missing) / here
    return at


def _check_turns(
    beam: str, curve: Callable, u: np.ndarray, lengths: np.ndarray, wanted: np.ndarray
) -> None:
    """Raises an error for elements that turn too much to be like their curve."""
    tangents = _evaluated(beam, curve, u)[1]
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    chords = np.linalg.norm(np.diff(tangents, axis=0), axis=1)
    turned = np.append(0.0, np.cumsum(2 * np.arcsin(np.minimum(chords / 2, 1.0))))
    by_element = np.degrees(np.diff(np.interp(wanted, lengths, turned)))
    worst = int(np.argmax(by_element))
    if by_element[worst] > _LARGEST_TURN:
        raise ValueError(
            f"Element {worst} of '{beam}' would turn by {by_element[worst]:.0f} degrees "
            f"along its curve, and at most {_LARGEST_TURN:.0f} are meaningful: use more "
            f"`elements` than {by_element.size}. (Eight or more for a circle.)"
        )


def _transported(
    beam: str, curve: Callable, at: np.ndarray, tangents: np.ndarray, normal: Any
) -> np.ndarray:
    """Axis 2 of each section, without rotation about the tangent.

    W. Wang, B. Juettler, D. Zheng and Y. Liu, ACM Trans. Graph. 27 (2008) 2: two
    reflections for each piece of the curve, of fourth order in its length.
    """
    u = np.linspace(at[:-1], at[1:], _FINE + 1, axis=1)
    points, slopes = _evaluated(beam, curve, u.ravel())
    along = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    seconds = [_across(beam, tangents[0], normal)]
    for k in range(len(points) - 1):
        second, chord = seconds[-1], points[k + 1] - points[k]
        if k % (_FINE + 1) != _FINE:  # else the first point of the next element follows
            second = _reflected(second, chord)
            second = _reflected(second, along[k + 1] - _reflected(along[k], chord))
        seconds.append(second)
    return np.array([*seconds[:: _FINE + 1], seconds[-1]])


def _reflected(x: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return x - 2 * (x @ normal) / (normal @ normal) * normal
