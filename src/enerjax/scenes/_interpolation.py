"""Poses between the rows of a run, by cubic polynomials with the rates of the rows.

Positions are interpolated in space. A rotation is the exponential of a rotation vector from
the row before, which is interpolated: a steady spin is exact, and a pose is always rigid.
The error is of fourth order in the distance of the rows.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from .._run import must_be_close, warn_if_visible


Array: TypeAlias = np.ndarray


class Frames(NamedTuple):
    """The frames of bodies in the rows of a run, and their rates.

    - `position`, `velocity`: shape `(rows, bodies, d)`.
    - `rotation`: shape `(rows, bodies, d, d)`, body axes along columns.
    - `angle`: in the plane, over full turns, shape `(rows, bodies)`.
    - `spin`: the angular velocity in the frame of the body, shape `(rows, bodies, 3)`, in
      the plane `(rows, bodies, 1)`.
    """

    position: Array
    rotation: Array
    angle: Array
    velocity: Array
    spin: Array

    @staticmethod
    def from_axes(
        values: tuple[Array, Array, Array], rates: tuple[Array, Array, Array]
    ) -> "Frames":
        """From origins, axes (as rows) and angles, and their rates."""
        (origin, axes, angle), (velocity, turning, angular) = values, rates
        if origin.shape[-1] == 2:
            spin = angular[..., None]
        else:
            # The columns of R^T Rdot, which is skew.
            skew = np.einsum("...ik,...jk->...ij", axes, turning)
            spin = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
        return Frames(origin, np.swapaxes(axes, -1, -2), angle, velocity, spin)

    def rows(self, index: Array) -> "Frames":
        return Frames(*(x[index] for x in self))


def frames_at(ts: Array, rows: Frames, times: Array) -> Frames:
    """The frames at `times` within `ts`, with a warning where the rows are too far apart.

    The rates are those of the row before.
    """
    number = np.clip(np.searchsorted(ts, times, side="right") - 1, 0, len(ts) - 1)
    last = np.minimum(number + 1, len(ts) - 1)
    h = ts[last] - ts[number]
    part = np.where(h > 0, (times - ts[number]) / np.where(h > 0, h, 1), 0.0)
    if np.any((part > 0) & (part < 1)):
        _warn_if_coarse(ts, rows)
    return _between(rows.rows(number), rows.rows(last), h, part)


def _between(a: Frames, b: Frames, h: Array, part: Array) -> Frames:
    x, h = part[:, None, None], h[:, None, None]
    # The rates after a row at the end would have no meaning.
    of_end = x**2 * (3 - 2 * x)
    first, last = h * x * (1 - x) ** 2, h * x**2 * (x - 1)
    position = a.position + of_end * (b.position - a.position)
    position = position + first * a.velocity + last * b.velocity
    if position.shape[-1] == 2:
        turned, end = (b.angle - a.angle)[..., None], b.spin
    else:
        turned = _rotation_vector(a, b, h)
        end = _rate_of_vector(turned, b.spin, h)
    vector = of_end * turned + first * a.spin + last * end
    if position.shape[-1] == 2:
        angle = a.angle + vector[..., 0]
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
        # The frames of points and of the ground do not turn, whatever their angle.
    else:
        angle, rotation = a.angle, a.rotation @ _exponential(vector)
    return Frames(position, rotation, angle, a.velocity, a.spin)


def _rotation_vector(a: Frames, b: Frames, h: Array) -> Array:
    """The vector of the rotation from `a` to `b`, in the frame of `a`, over full turns.

    The spins predict the number of turns, which the two rotations do not tell.
    """
    vector = _logarithm(np.swapaxes(a.rotation, -1, -2) @ b.rotation)
    predicted = 0.5 * h * (a.spin + b.spin)
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    expected = np.linalg.norm(predicted, axis=-1, keepdims=True)
    fallback = predicted / np.where(expected > 0, expected, 1)
    axis = np.where(size > 1e-9, vector / np.where(size > 0, size, 1), fallback)
    along = np.sum(axis * predicted, axis=-1, keepdims=True)
    turns = np.round((along - size) / (2 * np.pi))
    return vector + 2 * np.pi * turns * axis


def _rate_of_vector(vector: Array, spin: Array, h: Array) -> Array:
    """The rate of a rotation vector that belongs to a spin in the frame of its end."""
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    small = size < 1e-3
    safe = np.where(small, 1.0, size)
    # 1/x^2 - cot(x/2)/(2x), which tends to 1/12, and is infinite at a full turn.
    factor = np.where(small, 1 / 12, 1 / safe**2 - 0.5 / np.tan(safe / 2) / safe)
    across = np.cross(vector, spin)
    rate = spin + 0.5 * across + factor * np.cross(vector, across)
    # Beyond, the rotation counts as steady.
    return np.where(size < 1.5 * np.pi, rate, vector / np.where(h > 0, h, 1))


def _logarithm(rotation: Array) -> Array:
    flat = scipy.spatial.transform.Rotation.from_matrix(
        rotation.reshape(-1, 3, 3)
    ).as_rotvec()
    return flat.reshape(*rotation.shape[:-2], 3)


def _exponential(vector: Array) -> Array:
    flat = scipy.spatial.transform.Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vector.shape[:-1], 3, 3)


def _warn_if_coarse(ts: Array, rows: Frames) -> None:
    """Warns if the polynomials miss the motion by what can be seen.

    Every other row is interpolated from its neighbours: over twice the distance the error
    is sixteen times as large.
    """
    must_be_close(len(ts))
    middle = np.arange(1, len(ts) - 1)
    before, here, after = (rows.rows(middle + k) for k in (-1, 0, 1))
    h = ts[middle + 1] - ts[middle - 1]
    found = _between(before, after, h, (ts[middle] - ts[middle - 1]) / h)
    size = np.ptp(rows.position.reshape(-1, rows.position.shape[-1]), axis=0).max()
    missed = np.abs(found.position - here.position).max() / (size if size > 0 else 1)
    turned = np.abs(found.rotation - here.rotation).max()
    warn_if_visible(max(missed, turned) / 16)
