"""Lengths, angles and forces of parts, along runs."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._analysis import ConsistentStart, Equilibrium
from .._system import State
from .._types import Real, Scalar
from ._feedback import link_of, measure_of, Moving
from ._functions import at_time, pushes
from ._laws import AbstractForceLaw, AbstractSpringLaw, Driven, Length
from ._layout import Layout
from ._measures import Turn
from ._parameters import Parameters
from ._relative_motions import each


class Readout(NamedTuple):
    """What a part measures.

    Shape `(times,)`, of one state `()`; of a part that acts on a point (`Load`,
    `Follower`, `ConstantForce`, `Position`) `(times, d)`, in space.

    - `value`: a length, an angle (radians), or a place (a vector of lengths).
    - `rate`: its rate (length per time, radians per time).
    - `force`: along it: a force (energy per length), of an angle a torque (energy). It is
      positive where it pushes points apart or turns the second body counterclockwise, so
      `force * rate` is its power. `None` where the part has none. That of a drive or a rod
      (`Distance`) is known of multipliers, so not of a `State`; of a run it is a mean over
      the step that ends at the row, and that of all others at the row itself.

    Joints tell an angle if they are hinges (a cylindrical joint too), else how far they
    slide. In the plane it is the difference of the angles of the bodies; in space it is
    counted from the start pose, of a joint with an `axis_b` from where its `frame_a` and
    `frame_b` agree. A torsion spring in space keeps to the angle within half a turn.
    """

    value: Array
    rate: Array
    force: Array | None


@eqx.filter_jit
def readout(
    layout: Layout,
    name: str,
    q: Float[Array, "... nq"],
    v: Float[Array, "... nv"],
    t: Float[Array, "..."],
    multipliers: Float[Array, "... 1"] | None,
    args: Parameters,
) -> Readout:
    """Of every state along the leading axes; angles in space within half a turn.

    `multipliers` are those of this part, if they are known.
    """

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
    if multipliers is None or not isinstance(law, Driven | Length):
        return found
    along = multipliers if found.value.ndim == q.ndim else multipliers[..., 0]
    # The rows of a drive have slope one, those of a rod are squares.
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
    """Along a run, over any number of turns; of a start, an equilibrium or a state."""
    measure = measure_of(layout, name)
    if isinstance(sol, State):
        state, times, turns = sol, t, False
    elif isinstance(sol, ConsistentStart | Equilibrium):
        state, times, turns = sol.state, t, False
    else:
        state, times, turns = sol.ys, sol.ts, isinstance(measure, Turn)
    times = jnp.asarray(times, state.q.dtype)
    held = None
    if name in rows and not isinstance(sol, State):
        held = sol.multipliers[..., rows[name]]
    lanes = jnp.broadcast_to(times, state.q.shape[:-1])
    found = readout(layout, name, state.q, state.v, lanes, held, args)
    return _over_turns(found, times) if turns else found


def _over_turns(found: Readout, times: Float[Array, "... times"]) -> Readout:
    """An angle in space, as it goes on from the first row.

    What the rates say of the next row tells the number of turns between them: a row may
    be many turns from the one before.
    """
    mean = 0.5 * (found.rate[..., 1:] + found.rate[..., :-1])
    jump = jnp.diff(found.value) - mean * jnp.diff(times)
    turns = jnp.cumsum(-jnp.round(jump / (2 * jnp.pi)), axis=-1)
    rest = found.value[..., 1:] + 2 * jnp.pi * turns
    return found._replace(value=jnp.concatenate([found.value[..., :1], rest], axis=-1))
