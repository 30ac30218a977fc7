"""Events: zeros of functions of the state, at which a step ends.

A step in which a function changes its sign is repeated with other lengths until it ends at
the zero, to round-off. Each of these steps satisfies the step equations, so the state at an
event satisfies the constraints and the energy law as every other state does. The event may
then change the state. Derivatives of the length of the step follow from the implicit
function theorem, for the function and the step equations together.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from typing_extensions import TypeAliasType

from .._programs import is_known
from .._system import State
from .._types import Args, Coordinates, Count, Real, Scalar, Velocities
from .inputs import positive_integer


StateFunction = TypeAliasType(
    "StateFunction", Callable[[Coordinates, Velocities, Scalar, Args], Any]
)


class AbstractEvent(eqx.Module):
    """Something that happens at a zero of a function of the state.

    - `direction`: 1 for zeros at which the function rises, -1 for those at which it falls,
      0 for both.
    - `terminal`: whether the run ends there.
    """

    direction: eqx.AbstractVar[int]
    terminal: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def value(self, state: State, t: Scalar, args: Args) -> Scalar:
        """The function whose zeros are the events; `state` is one of the user."""


class Event(AbstractEvent):
    """A zero of `fn(q, v, t, args)`, at which the run ends, or the state or `args` change.

    The step that contains the zero ends there, to round-off, and satisfies the step
    equations. Times of events have the order of the scheme, and derivatives.

    **Arguments:**

    - `fn`: a scalar, smooth function of the state, in any unit.
    - `direction`: 1 for zeros at which it rises, -1 for those at which it falls, 0 for
      both.
    - `terminal`: whether the run ends at the first of these zeros. Rows after it are NaN,
      and `Solution.end` is the state at the event.
    - `reset`: a function `reset(q, v, t, args)` that returns the pair `(q, v)` after the
      event. It must satisfy the constraints. Leave it out if the state does not change.
    - `reset_args`: a function `reset_args(q, v, t, args)` that returns the `args` after the
      event: a latch that opens, a law that switches. Only floats can change, and the state
      must satisfy the constraints for the new ones. It is called with the state before the
      event. Leave it out if `args` do not change.

    **Raises:** `TypeError` for what is no function; `ValueError` for another direction.
    """

    fn: StateFunction
    direction: int = eqx.field(static=True, default=0, kw_only=True)
    terminal: bool = eqx.field(static=True, default=False, kw_only=True)
    reset: StateFunction | None = eqx.field(default=None, kw_only=True)
    reset_args: StateFunction | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        for name in ("fn", "reset", "reset_args"):
            fn = getattr(self, name)
            if not (callable(fn) or (name != "fn" and fn is None)):
                raise TypeError(
                    f"`{name}` must be a function of (q, v, t, args), got {fn!r}."
                )
        if self.direction not in (-1, 0, 1):
            raise ValueError(
                "`direction` must be 1 (the function rises), -1 (it falls) or 0 (both), "
                f"got {self.direction!r}."
            )

    def value(self, state: State, t: Scalar, args: Args) -> Scalar:
        value = jnp.asarray(self.fn(state.q, state.v, t, args))
        if value.shape != ():
            raise ValueError(
                f"The function `fn` of an `Event` must return a scalar, got {value.shape}."
            )
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise TypeError(
                "The function `fn` of an `Event` must return a float that passes zero, got "
                f"{value.dtype}: write `q[0] - 0.5` in place of `q[0] < 0.5`."
            )
        return value

    def state_after(self, state: State, t: Scalar, args: Args) -> State:
        """The user's state after the event."""
        if self.reset is None:
            return state
        after = self.reset(state.q, state.v, t, args)
        if not isinstance(after, tuple) or len(after) != 2:
            raise TypeError(f"`reset` must return the pair (q, v), got {after!r}.")
        q, v = (jnp.asarray(x) for x in after)
        if (q.shape, v.shape) != (state.q.shape, state.v.shape):
            raise ValueError(
                f"`reset` must return (q, v) of the shapes {state.q.shape} and "
                f"{state.v.shape}, got {q.shape} and {v.shape}."
            )
        return State(q.astype(state.q.dtype), v.astype(state.v.dtype))

    def args_after(self, state: State, t: Scalar, args: Args) -> Args:
        """The `args` after the event; only floats may be others."""
        if self.reset_args is None:
            return args
        new = self.reset_args(state.q, state.v, t, args)
        if jax.tree.structure(new) != jax.tree.structure(args):
            raise ValueError(
                "`reset_args` must return `args` of the same structure, "
                f"{jax.tree.structure(args)}, got {jax.tree.structure(new)}."
            )

        def changed(x: Any, y: Any) -> Any:
            if not eqx.is_inexact_array(x):
                if x is y or (is_known((x, y)) and np.array_equal(x, y)):
                    return x
                raise TypeError(
                    f"`reset_args` changes {x!r}, which is no float. Only floats can "
                    "change in a run: write 1.0 and 0.0, for example, for a latch."
                )
            y = jnp.asarray(y)
            if y.shape != x.shape:
                raise ValueError(
                    f"`reset_args` must not change shapes: {x.shape} became {y.shape}."
                )
            return y.astype(x.dtype)

        return jax.tree.map(changed, args, new)


class Impact(AbstractEvent):
    """A hit at which a `gap` closes, with Newton's law of restitution.

    At the hit the rate of the gap is reversed, `rate_after = -restitution * rate_before`,
    by an impulse along the gradient of the gap that changes no constraint and no velocity
    constraint. The energy changes by `-(1 - restitution^2)/2 rate_before^2 / w` with the
    inverse inertia `w` along the gradient, on the constraints; the audit counts the loss as
    `impact`. Impacts that happen at once are applied one after another, in their order,
    until none of these gaps closes any more. In a driven mechanism `impact` includes the
    work that the drives do during the hit.

    A gap stays closed if its next hit would follow within the length of a step, and if the
    hop until then would be lower than a thousandth of the largest gap before (with a
    `StepController`, than the part `rtol` of it). Its rate is then set to zero, and it is a
    constraint until its force would pull. Bounces that become ever shorter thus end. After
    elastic impacts, with a `restitution` written as the number 1, no gap stays closed.

    **Arguments:**

    - `gap`: `gap(q, args)`, a scalar that must not become negative: a distance or angle.
    - `restitution`: a number from 0 to 1, or a function of `args`.

    There is no friction. Contacts of many bodies with Coulomb friction are problems of
    another kind, for which other programs exist.

    **Raises:** `TypeError` for a gap that is no function, `ValueError` for a known
    restitution outside of [0, 1].

    **Reference:** F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts
    (1996), section 8, for Newton's law.
    """

    gap: Callable[[Coordinates, Args], Any]
    restitution: Real | Callable[[Args], Any] = 1.0
    direction: int = eqx.field(static=True, default=-1, init=False)
    terminal: bool = eqx.field(static=True, default=False, init=False)

    def __check_init__(self):
        if not callable(self.gap):
            raise TypeError(f"`gap` must be a function of (q, args), got {self.gap!r}.")
        e = self.restitution
        known = None if callable(e) or not is_known(e) else np.asarray(e)
        if known is not None and not np.all((known >= 0) & (known <= 1)):
            raise ValueError(f"`restitution` must be in [0, 1], got {e}.")

    def distance(self, q: Coordinates, args: Args) -> Scalar:
        value = jnp.asarray(self.gap(q, args))
        if value.shape != ():
            raise ValueError(f"`gap` must return a scalar, got shape {value.shape}.")
        return value.astype(q.dtype)

    def value(self, state: State, t: Scalar, args: Args) -> Scalar:
        return self.distance(state.q, args)

    def coefficient(self, args: Args, dtype: Any) -> Scalar:
        """The restitution."""
        e = self.restitution(args) if callable(self.restitution) else self.restitution
        return jnp.asarray(e, dtype)


def checked_events(events: Any, max_events: Any) -> tuple[tuple[AbstractEvent, ...], int]:
    """The events as a tuple, and the checked bound on their number."""
    if isinstance(events, AbstractEvent):
        events = (events,)
    if not isinstance(events, Sequence) or not all(
        isinstance(event, AbstractEvent) for event in events
    ):
        raise TypeError(
            f"`events` must be an `Event`, an `Impact`, or a list of them, got {events!r}."
        )
    return tuple(events), positive_integer("max_events", max_events)


class Events(eqx.Module):
    """The events of a run, in the order of time. Entries after the last event are NaN.

    - `ts`: their times, shape `(max_events,)`.
    - `happened`: which events happened at each time, shape `(max_events, events)`. For an
      `Impact` this is a hit, or the release of a gap that has stayed closed.
    - `closed`: which gaps stay closed after each time, shape `(max_events, events)`.
    - `before`, `after`: the states on both sides, with `q` of shape `(max_events, nq)`.
    - `count`: the number of times.
    - `contact_forces`: the forces of gaps that stay closed, in the steps that end at the
      rows of the solution, shape `(times, events)`; zero for all others.
    """

    ts: Float[Array, " max_events"]
    happened: Bool[Array, "max_events events"]
    closed: Bool[Array, "max_events events"]
    before: State
    after: State
    count: Count
    contact_forces: Float[Array, "times events"]
