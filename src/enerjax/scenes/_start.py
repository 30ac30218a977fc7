"""The start of a scene, and checks of its gaps, drives and velocities."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._analysis import start_near
from .._programs import is_known
from .._system import State, System
from .._types import Real
from ._closure_errors import by_name, Measured, measured
from ._functions import drives_at
from ._laws import Deviation, Driven
from ._layout import Layout
from ._measures import AbstractTurn
from ._parameters import Parameters
from ._pose_view import evaluate, lift, View
from ._row_index import first_dependent


# A gap that is larger than this fraction of the bodies, or of their speed, is a mistake;
# smaller ones are closed.
_MISTAKE = 0.05


def gaps_of(layout: Layout, state: State, t: Real, args: Parameters) -> dict[str, Measured]:
    """The gap of each joint, constraint and drive."""
    q, rates = state.q, lift(layout, state.q, state.v)
    return by_name(layout, measured(layout, q, rates, jnp.asarray(t, q.dtype), args))


def check_poses(
    found: dict[str, Measured], ends: dict[str, tuple[str, str]], t: Real
) -> None:
    """Raises an error for a joint that is far from closed."""
    for name, gap in found.items():
        if not np.isfinite([gap.position, gap.velocity]).all():
            raise ValueError(
                f"The function of '{name}' has no finite value and rate at the start, "
                f"t = {t}: it must be smooth there."
            )
        if name in ends and gap.position > _MISTAKE * gap.size:
            a, b = ends[name]
            raise ValueError(
                f"'{name}' is off by {gap.position:.3g} at the start, of bodies of size "
                f"{gap.size:.3g}: the poses of '{a}' and '{b}' do not fit its points, "
                "axes, length or motion. Points and axes are in the frames of the bodies, "
                "whose origin is the mass centre."
            )


class PartialStart(NamedTuple):
    """A start of which only the velocities with the indices `prescribed` are known.

    The others are zero in `state`.
    """

    state: State
    prescribed: tuple[int, ...]


def closed_start(
    layout: Layout,
    system: System,
    partial: PartialStart,
    t: Real,
    args: Parameters,
    rows: dict[str, slice],
) -> State:
    """The nearest state with all joints closed; see `Scene.start`."""
    guess, prescribed = partial
    known = is_known((guess, t, args))
    if layout.drives and known:
        check_poses(gaps_of(layout, guess, t, args), {}, t)
    # If all velocities are prescribed they all change, by as little as possible.
    kept = prescribed if len(prescribed) < guess.v.size else ()
    try:
        start = start_near(system, guess, args, t, kept)
    except ValueError as error:
        name = first_dependent(layout, guess.q, t, args, rows) if known else None
        if name is None:
            raise
        message = str(error).replace("`System(", "`Scene(")
        raise ValueError(
            f"{message} In this scene '{name}' repeats constraints of other joints."
        ) from None
    if known and is_known(start):
        _check_velocities(layout, partial, start, t, args)
    return _check_turns(layout, start, t, args)


def _check_velocities(
    layout: Layout, partial: PartialStart, start: State, t: Real, args: Parameters
) -> None:
    """Raises an error if the prescribed velocities are far from those that joints admit."""
    indices = np.array(partial.prescribed, int)
    v = np.array(start.v)
    v[indices] = np.asarray(partial.state.v)[indices]
    if np.max(np.abs(v - np.asarray(start.v))) <= 1e-6 * np.max(np.abs(v)):
        return
    for name, gap in gaps_of(layout, State(start.q, jnp.asarray(v)), t, args).items():
        if gap.velocity > _MISTAKE * gap.speed:
            raise ValueError(
                f"The velocities of the bodies do not fit '{name}': its gap would grow at "
                f"{gap.velocity:.3g}, with bodies that move at {gap.speed:.3g}. Leave out "
                "the velocities that follow from the joints. (`initial_state(scene.system, "
                "scene.q, scene.v, scene.args)` finds the nearest that fit.)"
            )


def _check_turns(layout: Layout, start: State, t: Real, args: Parameters) -> State:
    """The start, with an error if a driven angle in space is half a turn from its value.

    The sine of the difference, which is the constraint, vanishes there too.
    """
    t = jnp.asarray(t, start.q.dtype)
    for group, numbers in drives_at(layout, t, args):
        measure = group.law.measure if isinstance(group.law, Driven) else None
        if not isinstance(measure, AbstractTurn):
            continue
        deviation = group._replace(law=Deviation(measure))
        error = jnp.abs(evaluate(deviation, View(layout, start.q), numbers))[:, 0]
        opposite = jax.lax.stop_gradient(error > np.pi / 2)
        message = (
            "the start is nearer to the opposite of the prescribed angle: give the bodies "
            "the angle of their drive."
        )
        if not is_known(opposite):
            start = eqx.error_if(start, opposite, f"{[*group.names]}: {message}")
        elif opposite.any():
            k = int(np.argmax(error))
            raise ValueError(f"'{group.names[k]}' is off by {error[k]:.3g}: {message}")
    return start
