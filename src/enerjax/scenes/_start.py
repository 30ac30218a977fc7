"""What a start must have: joints almost closed, smooth motions, velocities that fit."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._analysis import start_near
from .._programs import is_known
from .._system import State, System
from .._types import Real
from ._constraint_rows import first_dependent
from ._functions import drives_at
from ._gaps import by_name, Measured, measured
from ._laws import Driven, Missed
from ._layout import Layout
from ._measures import Turn
from ._parameters import Parameters
from ._view import evaluate, lift, View


# What is further off than this part of its bodies, or of their speed, is a mistake.
_FAR = 0.05


def gaps_of(layout: Layout, state: State, t: Real, args: Parameters) -> dict[str, Measured]:
    """How far each joint, constraint and drive is from closed."""
    q, rates = state.q, lift(layout, state.q, state.v)
    return by_name(layout, measured(layout, q, rates, jnp.asarray(t, q.dtype), args))


def check_poses(
    found: dict[str, Measured], ends: dict[str, tuple[str, str]], t: Real
) -> None:
    """Raises for joints that are not almost closed."""
    for name, gap in found.items():
        if not np.isfinite([gap.position, gap.velocity]).all():
            raise ValueError(
                f"What '{name}' prescribes has no finite value and rate at the start, "
                f"t = {t}: its function must be smooth there."
            )
        if name in ends and gap.position > _FAR * gap.size:
            a, b = ends[name]
            raise ValueError(
                f"'{name}' is off by {gap.position:.3g} at the start, of bodies of size "
                f"{gap.size:.3g}: the poses of '{a}' and '{b}' do not fit its points, "
                "axes, length or motion. Points and axes are told in the frames of the "
                "bodies, whose origin is the mass centre."
            )


class Told(NamedTuple):
    """A start as the parts tell it: velocities that are not `given` are zero."""

    state: State
    given: tuple[int, ...]


def closed_start(
    layout: Layout,
    system: System,
    told: Told,
    t: Real,
    args: Parameters,
    rows: dict[str, slice],
) -> State:
    """The state nearest to what is told with all joints closed; see `Scene.start`."""
    known = is_known((told.state, t, args))
    if layout.drives and known:
        check_poses(gaps_of(layout, told.state, t, args), {}, t)
    # Where all velocities are told the nearest are those with the least change.
    partly = told.given if len(told.given) < told.state.v.size else ()
    try:
        start = start_near(system, told.state, args, t, partly)
    except ValueError as error:
        name = first_dependent(layout, told.state.q, t, args, rows) if known else None
        if name is None:
            raise
        message = str(error).replace("`System(", "`Scene(")
        raise ValueError(
            f"{message} In this scene '{name}' repeats what other joints hold already."
        ) from None
    if known and is_known(start):
        _check_velocities(layout, told, start, t, args)
    return _check_turns(layout, start, t, args)


def _check_velocities(
    layout: Layout, told: Told, start: State, t: Real, args: Parameters
) -> None:
    """Raises where velocities that were given are not near to any that joints admit."""
    numbers = np.array(told.given, int)
    v = start.v.at[numbers].set(told.state.v[numbers])
    if np.max(np.abs(v - start.v)) <= 1e-6 * np.max(np.abs(v)):
        return
    for name, gap in gaps_of(layout, State(start.q, v), t, args).items():
        if gap.velocity > _FAR * gap.speed:
            raise ValueError(
                f"The velocities that are given do not fit '{name}': it would part at "
                f"{gap.velocity:.3g}, with bodies that move at {gap.speed:.3g}. Leave out "
                "those that follow from the joints. (`initial_state(scene.system, "
                "scene.q, scene.v, scene.args)` finds the nearest that fit.)"
            )


def _check_turns(layout: Layout, start: State, t: Real, args: Parameters) -> State:
    """The start, if no driven angle in space is half a turn away from its value.

    The sines that are held vanish there too.
    """
    t = jnp.asarray(t, start.q.dtype)
    for group, numbers in drives_at(layout, t, args):
        if not isinstance(group.law, Driven) or not isinstance(group.law.measure, Turn):
            continue
        missed = group._replace(law=Missed(group.law.measure))
        error = jnp.abs(evaluate(missed, View(layout, start.q), numbers))[:, 0]
        opposite = jax.lax.stop_gradient(error > np.pi / 2)
        message = (
            "the pose of the start is nearer to the opposite of what is prescribed: give "
            "the bodies the angle of their drive."
        )
        if not is_known(opposite):
            start = eqx.error_if(start, opposite, f"{[*group.names]}: {message}")
        elif opposite.any():
            k = int(np.argmax(error))
            raise ValueError(f"'{group.names[k]}' is off by {error[k]:.3g}: {message}")
    return start
