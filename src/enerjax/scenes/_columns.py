"""The motion of a scene as columns of a table."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import compiled
from ._body_coordinates import AXES
from ._frames import GROUND
from ._layout import Layout
from ._motion_view import measures_of, Moving
from ._parameters import Parameters
from ._reactions import each, Reaction
from ._readouts import Readout
from ._rotations import quaternion_of


Columns = dict[str, np.ndarray]


def of_bodies(layout: Layout, q: Array, v: Array, args: Parameters) -> Columns:
    """Poses and velocities of all bodies, `(times,)` each."""
    motion = {name: np.asarray(x) for name, x in _motion(layout, q, v, args).items()}
    columns: Columns = {}
    for body, k in layout.numbers_of_bodies.items():
        if body == GROUND:
            continue
        for letter, kind in (("", "position"), ("v", "velocity")):
            columns |= _by_axis(f"{body}.{letter}", motion[kind][:, k])
        if not layout.turning[k]:
            continue
        if layout.dimension == 2:
            columns[f"{body}.angle"] = motion["angle"][:, k]
            columns[f"{body}.angle_rate"] = motion["angle_rate"][:, k]
            continue
        quaternion = _without_jumps(motion["quaternion"][:, k])
        columns |= {f"{body}.q{x}": quaternion[:, i] for i, x in enumerate(("w", *AXES))}
        columns |= _by_axis(f"{body}.omega_", motion["spin"][:, k])
    return columns


@compiled
def _motion(layout: Layout, q: Array, v: Array, args: Parameters) -> dict[str, Array]:
    """The motion of all bodies, `(times, bodies + 1, ...)`; the first is the ground."""

    def of_state(q: Array, v: Array) -> dict[str, Array]:
        view = Moving(layout, q, v, args)
        position, velocity = view.with_rate(lambda view: view.origins)
        found = dict(position=position, velocity=velocity)
        if layout.dimension == 2:
            found["angle"], found["angle_rate"] = view.with_rate(lambda view: view.angles)
            return found
        axes, rates = view.with_rate(lambda view: view.axes)
        found["quaternion"] = jax.vmap(lambda x: quaternion_of(x.T))(axes)
        # The rate of an axis is the cross product of the angular velocity and the axis.
        return found | dict(spin=0.5 * jnp.sum(jnp.cross(axes, rates), axis=1))

    return each(of_state, q, v)


def _without_jumps(quaternions: Float[np.ndarray, "times 4"]) -> np.ndarray:
    """The quaternions of a run with signs by which they are continuous."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.where(np.cumsum(turned) % 2 == 1, -1.0, 1.0)
    return quaternions * np.append(1.0, signs)[:, None]


def of_readout(layout: Layout, name: str, readout: Readout) -> Columns:
    """The length or angle of a part, its rate, and the force or torque along it."""
    is_angle = measures_of(layout)[name].is_angle
    parts = {
        "angle" if is_angle else "length": readout.value,
        "angle_rate" if is_angle else "length_rate": readout.rate,
        "torque" if is_angle else "force": readout.force,
    }
    if readout.value.ndim == 1:
        return {f"{name}.{key}": np.asarray(x) for key, x in parts.items() if x is not None}
    columns = _by_axis(f"{name}.", readout.value) | _by_axis(f"{name}.v", readout.rate)
    if readout.force is not None:
        columns |= _by_axis(f"{name}.force_", readout.force)
    return columns


def of_reaction(name: str, reaction: Reaction) -> Columns:
    torque = np.asarray(reaction.torque)
    columns = _by_axis(f"{name}.reaction_", reaction.force)
    if torque.shape[-1] == 1:
        return columns | {f"{name}.reaction_torque": torque[:, 0]}
    return columns | _by_axis(f"{name}.reaction_torque_", torque)


def _by_axis(name: str, vectors: Any) -> Columns:
    columns: Iterator[np.ndarray] = iter(np.asarray(vectors).T)
    return {name + axis: x for axis, x in zip(AXES, columns, strict=False)}
