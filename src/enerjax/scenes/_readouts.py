"""Lengths, angles and forces of parts along runs."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._analysis import ConsistentStart, Equilibrium
from .._programs import compiled
from .._system import State
from .._types import Real, Scalar
from ._force import pushes
from ._laws import AbstractForceLaw, AbstractSpringLaw, Driven, Flywheel, Length
from ._layout import Layout
from ._measures import AbstractTurn
from ._motion_view import link_of, measure_of, Moving
from ._parameters import Parameters
from ._reactions import each
from ._signals import at_time


class Readout(NamedTuple):
    """The length or angle of a part, its rate, and the force along it.

    The shape is `(times,)`, for one state `()`; for a part that acts on a point (`Load`,
    `Follower`, `ConstantForce`, `Position`) it is `(times, d)`, in space.

    - `value`: a length, an angle (radians), or a position (a vector of lengths).
    - `rate`: its rate (length per time, radians per time).
    - `force`: a force (energy per length), or a torque (energy) for an angle. It is
      positive if it pushes points apart or turns the second body counterclockwise, so
      `force * rate` is its power. `None` if the part has no force. The force of a drive,
      an inerter or a rod (`Distance`) follows from multipliers: it is not known for a
      `State`, and for a run it is the mean over the step that ends at the row.

    The value of a revolute or cylindrical joint is its angle, that of a prismatic joint its
    displacement. In the plane an angle is the difference of the angles of the bodies. In
    space it is zero in the start pose (for a joint with an `axis_b`, where its `frame_a`
    and `frame_b` agree). The force of a torsion spring in space is that of the angle within
    half a turn.
    """

    value: Array
    rate: Array
    force: Array | None


@compiled
def readout(
    layout: Layout,
    name: str,
    q: Float[Array, "... nq"],
    v: Float[Array, "... nv"],
    t: Float[Array, "..."],
    multipliers: Float[Array, "... 1"] | None,
    args: Parameters,
) -> Readout:
    """The readout of every state along the leading axes; angles in space are within half a
    turn. `multipliers` are those of this part, if they are known."""

    def of_state(q: Array, v: Array, t: Scalar) -> Readout:
        view = Moving(layout, q, v, args)
        group, numbers = link_of(layout, name, args)
        value, rate = view.measured(name)
        force = None
        if isinstance(group.law, AbstractForceLaw):
            numbers = at_time(group, numbers, t, args, view)
            force = pushes(group, numbers, view, rate[None])[0]
        elif isinstance(group.law, AbstractSpringLaw):
            own = {key: x[0] for key, x in numbers.items()}
            force = -jax.grad(group.law.energy)(value, own)
        return Readout(value, rate, force)

    found = each(of_state, q, v, t)
    law = link_of(layout, name, args)[0].law
    if multipliers is None or not isinstance(law, Driven | Flywheel | Length):
        return found
    along = multipliers if found.value.ndim == q.ndim else multipliers[..., 0]
    # The rows of drives and inerters have slope one; that of a rod is a difference of
    # squared lengths.
    slope = 2 * found.value if isinstance(law, Length) else 1.0
    return found._replace(force=-slope * along)


def measured_along(
    layout: Layout,
    rows: dict[str, slice],
    sol: Any,
    name: str,
    t: Real,
    args: Parameters,
) -> Readout:
    """The readout of a run, with full turns of angles, or of a start or another state."""
    measure = measure_of(layout, name)
    if isinstance(sol, State):
        state, times, turns = sol, t, False
    elif isinstance(sol, ConsistentStart | Equilibrium):
        state, times, turns = sol.state, t, False
    else:
        state, times, turns = sol.ys, sol.ts, isinstance(measure, AbstractTurn)
    times = jnp.asarray(times, state.q.dtype)
    multipliers = None
    if name in rows and not isinstance(sol, State):
        multipliers = sol.multipliers[..., rows[name]]
    ts = jnp.broadcast_to(times, state.q.shape[:-1])
    found = readout(layout, name, state.q, state.v, ts, multipliers, args)
    return _over_turns(found, times) if turns else found


def _over_turns(found: Readout, times: Float[Array, "... times"]) -> Readout:
    """The readout with an angle in space that is continuous from the first row on.

    The rates predict the change from row to row, and thereby the number of full turns,
    even if there are many.
    """
    mean = 0.5 * (found.rate[..., 1:] + found.rate[..., :-1])
    jump = jnp.diff(found.value) - mean * jnp.diff(times)
    turns = jnp.cumsum(-jnp.round(jump / (2 * jnp.pi)), axis=-1)
    rest = found.value[..., 1:] + 2 * jnp.pi * turns
    return found._replace(value=jnp.concatenate([found.value[..., :1], rest], axis=-1))
