"""Steps whose lengths are chosen by an estimate of their errors."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, PyTree

from .._operators import AbstractModel
from .._programs import in_any_lane, is_known
from .._results import RESULTS
from .._solvers import ROOT
from .._system import order_for, State
from .._types import Count, Flag, Real, Scalar
from ..schemes import AbstractScheme, AbstractSchemeWithMemory
from .collocation import end_of, Pair, rates, rates_along
from .prediction import for_length, with_history
from .step import Warm
from .step_sizes import AbstractController, AbstractPlan, End, Verdict


# The steps that may be attempted by default.
MAX_STEPS = 4096
# The factor on the length of a step in which Newton's method failed.
_AFTER_FAILURE = 0.25
# Of the PI controller: Gustafsson's exponents 0.7 and 0.4 and safety factor, limits of the
# factor on the length, and the error below which it does not react any more.
_PROPORTIONAL, _INTEGRAL = 0.7, 0.4
_SAFETY = 0.9
_SHORTER, _LONGER = 0.2, 5.0
_SMALLEST_ERROR = 1e-4


def _as_tolerance(tolerance: Real) -> Scalar:
    array = jnp.asarray(tolerance, float)
    if is_known(array) and not (array.ndim == 0 and 0 < float(array) < jnp.inf):
        raise ValueError(
            f"The tolerances of a `StepController` must be positive, got {tolerance}: "
            "`StepController(rtol=1e-6, atol=1e-8)` allows each step errors of a "
            "millionth of the coordinates, and of 1e-8 where they are small."
        )
    return array


class StepController(AbstractController):
    """Chooses the steps of `simulate(..., t1=..., controller=...)` by their errors.

    The end of each step is compared with the integral of the equations of motion along the
    step: Picard's iteration on Lobatto's nodes, which starts from Hermite's polynomial
    through both ends. For schemes of orders 1 to 4 the difference `d` is the error of the
    step itself, up to terms of higher order; for orders 6 and 8 it is that of the integral,
    which is of order 5 and 7. A step is accepted if

        sqrt(mean((d / (atol + rtol max(|y0|, |y1|)))^2)) <= 1

    over all coordinates and velocities (momenta of a Hamiltonian system), and otherwise
    repeated with a shorter length. A step in which Newton's method fails is repeated with a
    quarter of its length. A PI controller with factors in [0.2, 5] proposes the next
    length. A step of any length has the properties of energy and constraints that the
    scheme promises.

    **Arguments:**

    - `rtol`, `atol`: tolerances, positive; traced, so that they can be swept. `atol` has
      the unit of each entry of `q` and `v`.

    **Raises:** `ValueError` for tolerances that are not positive.

    **Reference:** K. Gustafsson, ACM Trans. Math. Softw. 17 (1991) 533-554, for the
    controller; E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential
    Equations I, section II.4, for the norm; A. Dutt, L. Greengard and V. Rokhlin, BIT 40
    (2000) 241-266, for the iteration.
    """

    rtol: Scalar = eqx.field(converter=_as_tolerance)
    atol: Scalar = eqx.field(converter=_as_tolerance)

    def plan(
        self, scheme: AbstractScheme, h: Scalar, t0: Scalar, end: End
    ) -> "_ControlledPlan":
        if isinstance(scheme.stage, AbstractSchemeWithMemory):
            raise ValueError(
                f"`{type(scheme).__name__}` passes an acceleration from step to step that "
                "is valid for one step length only, so no `controller` can vary it. Pass "
                "`h` and `t1` alone, or use a one-step scheme, such as `EnergyDecaying`."
            )
        assert end.t1 is not None
        duration = end.t1 - t0
        return _ControlledPlan(
            t0=t0,
            t1=end.t1,
            unit=duration,
            last=jnp.ones_like(duration),
            max_attempts=MAX_STEPS if end.max_steps is None else end.max_steps,
            is_counted=False,
            controller=self,
            first_length=h / duration,
            order=scheme.order,
            stages=scheme.stages,
        )


class _Memory(eqx.Module):
    """What the controller remembers from one step to the next.

    - `length`: of the next step.
    - `before`: lengths of the last three accepted steps, newest first.
    - `error`: of the last accepted step.
    - `num_rejected`: the number of rejected steps in the run.
    - `rejected`: whether a step was rejected since the last accepted one.
    - `inaccurate`: whether one of these was rejected because of its error.
    - `rates`: the rates of change in the current state.
    """

    length: Scalar
    before: Float[Array, "3"]
    error: Scalar
    num_rejected: Count
    rejected: Flag
    inaccurate: Flag
    rates: Pair


class _ControlledPlan(AbstractPlan):
    """The steps of a `StepController`; their lengths are fractions of the whole time, and
    are constants for derivatives."""

    t0: Scalar
    t1: Scalar
    unit: Scalar
    last: Scalar
    max_attempts: int = eqx.field(static=True)
    is_counted: bool = eqx.field(static=True)
    controller: StepController
    first_length: Scalar
    order: int = eqx.field(static=True)
    stages: tuple[float, ...] = eqx.field(static=True)

    def begin(self, model: AbstractModel, start: State) -> _Memory:
        first = self.first()
        at_start = _constant(rates(model, start))
        same, one = jnp.full((3,), first), jnp.ones_like(first)
        no = jnp.array(False)
        return _Memory(
            length=first,
            before=same,
            error=one,
            num_rejected=jnp.array(0),
            rejected=no,
            inaccurate=no,
            rates=at_start,
        )

    def first(self) -> Scalar:
        return jax.lax.stop_gradient(jnp.minimum(self.first_length, 1.0))

    def next(self, memory: _Memory, place: Scalar) -> tuple[Scalar, Scalar]:
        # The last two steps divide the remaining time equally, so that none is tiny.
        left = 1 - place
        last = left <= 1.01 * memory.length
        length = jnp.minimum(memory.length, 0.5 * left)
        length = jnp.where(last, left, length)
        return jnp.where(last, 1.0, place + length), length

    def usual(self, memory: _Memory) -> Scalar:
        return memory.length

    @property
    def least_hop(self) -> Scalar:
        return self.controller.rtol.astype(self.unit.dtype)

    def after_event(
        self,
        old: _Memory,
        new: _Memory,
        model: AbstractModel,
        state: State,
        happened: Flag,
    ) -> _Memory:
        def changed(new: _Memory) -> _Memory:
            # The step was as short as the event wanted, which says nothing of the error.
            length = jnp.where(happened, jnp.maximum(old.length, new.length), new.length)
            at_start = _constant(rates(model, state))
            keep = lambda x, y: jnp.where(happened, x, y)
            at_start = jax.tree.map(keep, at_start, new.rates)
            where = lambda memory: (memory.length, memory.rates)
            return eqx.tree_at(where, new, (length, at_start))

        return jax.lax.cond(in_any_lane(happened), changed, lambda new: new, new)

    def warm(self, memory: _Memory, warm: Warm, length: Scalar) -> Warm:
        stages = for_length(warm.stages, self.stages, memory.before, length)
        return eqx.tree_at(lambda warm: warm.stages, warm, stages)

    def kept(self, new: Warm, old: Warm) -> Warm:
        stages = with_history(new.stages, old.stages)
        return eqx.tree_at(lambda warm: warm.stages, new, stages)

    def judge(
        self,
        memory: _Memory,
        model: AbstractModel,
        ends: tuple[State, State],
        result: RESULTS,
        length: Scalar,
    ) -> Verdict:
        known = _constant((model, *ends, self.unit * length, memory.rates))
        error, reached = _constant(self._error(*known))
        solved = result == RESULTS.successful
        accepted = solved & (error <= 1)
        power = 1 / estimate_order(order_for(model.system, self.order))
        error = jnp.maximum(error, _SMALLEST_ERROR)
        grown = _SAFETY * error ** (-_PROPORTIONAL * power)
        grown = grown * memory.error ** (_INTEGRAL * power)
        grown = jnp.clip(grown, _SHORTER, jnp.where(memory.rejected, 1.0, _LONGER))
        shrunk = jnp.maximum(_SAFETY * error**-power, _SHORTER)
        # An error that is NaN compares false.
        shrunk = jnp.where(solved & (error < jnp.inf), shrunk, _AFTER_FAILURE)
        next_length = length * jnp.where(accepted, grown, shrunk)
        next_length = jax.lax.stop_gradient(next_length)
        # The reverse pass keeps these two, so it need not repeat the estimates.
        accepted, next_length = checkpoint_name((accepted, next_length), ROOT)
        too_short = ~accepted & (next_length < jnp.finfo(length.dtype).eps ** 0.75)
        inaccurate = ~accepted & (solved | memory.inaccurate)
        cause = RESULTS.where(inaccurate, RESULTS.steps_too_short, result)
        before = jnp.concatenate([length[None], memory.before[:2]])
        choose = lambda new, old: jnp.where(accepted, new, old)
        after = _Memory(
            length=next_length,
            before=choose(before, memory.before),
            error=choose(error, memory.error),
            num_rejected=memory.num_rejected + jnp.where(accepted, 0, 1),
            rejected=~accepted,
            inaccurate=inaccurate,
            rates=jax.tree.map(choose, reached, memory.rates),
        )
        return Verdict(accepted, RESULTS.where(too_short, cause, RESULTS.successful), after)

    def num_rejected(self, memory: _Memory) -> Count:
        return memory.num_rejected

    @property
    def numbers(self) -> PyTree[Any]:
        return self.t0, self.t1, self.first_length, self.controller

    def with_events(self, attempts: int) -> "_ControlledPlan":
        more = self.max_attempts + attempts
        return dataclasses.replace(self, max_attempts=more, is_counted=False)

    def rounded_up(self) -> "_ControlledPlan":
        # Its bound on the attempts does not depend on the length of the run.
        return self

    def _error(
        self, model: AbstractModel, a: State, b: State, h: Scalar, at_start: Pair
    ) -> tuple[Scalar, Pair]:
        """The weighted norm of the error of a step, and the rates at its end."""
        at_end = rates(model, b)
        other = other_end(model, a, b, h, (at_start, at_end), self.order)
        join = lambda x: jnp.concatenate([x.q, x.v])
        x, y, z = join(a), join(b), join(other)
        rtol, atol = (
            x.astype(h.dtype) for x in (self.controller.rtol, self.controller.atol)
        )
        off = (y - z) / (atol + rtol * jnp.maximum(jnp.abs(x), jnp.abs(y)))
        return jnp.sqrt(jnp.mean(off**2)), at_end


def _constant(tree: Any) -> Any:
    """The tree with derivatives of zero."""
    stop = lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x
    return jax.tree.map(stop, tree)


def estimate_order(order: int) -> int:
    """The order in `h` of the error estimate of a scheme of this order."""
    return max(order, 2) + 1 if order <= 4 else order


def other_end(
    model: AbstractModel,
    a: State,
    b: State,
    h: Scalar,
    at_ends: tuple[Pair, Pair],
    order: int,
) -> State:
    """The end of a step from `a` to `b` by the integral of the rates along it.

    Its own error is `h^(order + 2)` up to order 4, and `h^order` above.
    """
    num_nodes = max(order if order <= 4 else order - 2, 3)
    f = rates_along(model, a, b, h, at_ends, num_nodes, num_nodes - 3)
    return end_of(a, h, f, b.t)
