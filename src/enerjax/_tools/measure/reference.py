"""The reference motions that errors are measured against."""

import dataclasses
import math
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..._operators import make_model
from ..._programs import compiled
from ..._results import RESULTS
from ..._run import SaveAt, simulate, Solution
from ..._system import AbstractSystem, order_for, State
from ..._types import Args, Scalar
from ...schemes import AbstractScheme, Composed, EnergyPreserving


Reals: TypeAlias = NDArray[np.floating[Any]]
# The two runs of a reference have so many times the steps of the finest measured run.
_FINER = (2, 4)


@dataclasses.dataclass(frozen=True)
class Task:
    """A motion, and the times at which errors are measured."""

    system: AbstractSystem
    start: State
    args: Args
    t0: float
    duration: float
    times: Reals

    def rows(self, num_steps: int) -> tuple[int, NDArray[np.int_]]:
        """The number of steps between saved rows, and the rows at the times of the task."""
        counts = num_steps * (self.times - self.t0) / self.duration
        whole = np.rint(counts).astype(int)
        # Between steps the error of an interpolant would be measured.
        missed = (np.abs(counts - whole) > 1e-6) | (whole < 1) | (whole > num_steps)
        if missed.any():
            time = self.times[missed][0]
            raise ValueError(
                f"No step of a run of {num_steps} steps from {self.t0:g} over "
                f"{self.duration:g} ends at t = {time:g}, a time of the reference. Leave "
                "this time out, or choose other numbers of steps."
            )
        every = math.gcd(num_steps, *whole.tolist())
        return every, whole // every

    def run(self, scheme: AbstractScheme, num_steps: int) -> Solution:
        """A run; its `result` tells whether it failed."""
        h = jnp.asarray(self.duration / num_steps, self.start.q.dtype)
        t0 = jnp.asarray(self.t0, h.dtype)
        every, _ = self.rows(num_steps)
        start = State(self.start.q, self.start.v)
        solution = _run(self.system, scheme, start, self.args, h, t0, num_steps, every)
        return jax.block_until_ready(solution)


@compiled
def _run(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args,
    h: Scalar,
    t0: Scalar,
    num_steps: int,
    every: int,
) -> Solution:
    return simulate(
        system,
        scheme,
        start,
        args,
        h=h,
        num_steps=num_steps,
        t0=t0,
        saveat=SaveAt(every=every),
        throw=False,
    )


@dataclasses.dataclass(frozen=True)
class Values:
    """A motion at the times of a task; unknown entries are NaN."""

    q: Reals
    v: Reals
    multipliers: Reals
    energy: Reals


@dataclasses.dataclass(frozen=True)
class Reference:
    """The motion that errors are measured against, and its uncertainty.

    The uncertainty is the change by the extrapolation; 0 for data.
    """

    values: Values
    uncertainty: dict[str, float]


def extrapolated(task: Task, finest: int, scheme: AbstractScheme | None) -> Reference:
    """The extrapolation to `h = 0` of two runs with shorter steps (Richardson)."""
    forced = task.system.force is not None
    if scheme is None:
        scheme = EnergyPreserving() if forced else Composed(EnergyPreserving(), 6)
    order = order_for(task.system, scheme.order)
    coarse, fine = (_reached(task, scheme, factor * finest) for factor in _FINER)
    gain = (_FINER[1] / _FINER[0]) ** order - 1
    q, v = (b + (b - a) / gain for a, b in zip(coarse, fine, strict=True))
    values, rough = at_states(task, q, v), at_states(task, *fine)
    names = ("q", "v", "multipliers")
    change = lambda name: np.abs(getattr(values, name) - getattr(rough, name))
    return Reference(values, {name: float(change(name).max(initial=0.0)) for name in names})


def _reached(task: Task, scheme: AbstractScheme, num_steps: int) -> tuple[Reals, Reals]:
    solution = task.run(scheme, num_steps)
    if solution.result != RESULTS.successful:
        raise ValueError(
            f"The reference, {num_steps} steps with {type(scheme).__name__}, failed: "
            f"{RESULTS[solution.result]} Give more steps, another scheme or data as "
            "`reference`."
        )
    _, rows = task.rows(num_steps)
    return np.asarray(solution.ys.q)[rows], np.asarray(solution.ys.v)[rows]


def at_states(task: Task, q: Reals, v: Reals) -> Values:
    """The multipliers and energies that belong to states at the times of a task."""
    multipliers, energy = _balance(
        task.system, State(q, v, jnp.asarray(task.times)), task.args
    )
    return Values(q, v, np.asarray(multipliers), np.asarray(energy))


@compiled
def _balance(system: AbstractSystem, states: State, args: Args):
    def at(state: State):
        if not system.is_timed:
            state = State(state.q, state.v)
        model = make_model(system, state, args)
        inner = model.to_internal(state)
        return model.accelerations(inner)[1], system.energy(state, args)

    return jax.vmap(at)(states)


def from_data(task: Task, q: Reals, v: Reals | None) -> Reference:
    """The reference that consists of a user's data."""
    if v is None:
        # Without velocities only positions can be compared.
        unknown = np.full((len(q), 1), np.nan)
        values = Values(q, unknown, unknown, unknown[:, 0])
    else:
        values = at_states(task, q, v)
    return Reference(values, dict(q=0.0, v=0.0, multipliers=0.0))
