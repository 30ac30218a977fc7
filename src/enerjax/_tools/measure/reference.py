"""What errors are measured against."""

import dataclasses
import math
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..._operators import make_model
from ..._results import RESULTS
from ..._run import SaveAt, simulate, Solution
from ..._system import AbstractSystem, State
from ..._types import Args, Scalar
from ...schemes import AbstractScheme, Composed, EnergyPreserving


Reals: TypeAlias = NDArray[np.floating[Any]]
# Steps of the two runs behind a reference, against those of the finest run measured.
_FINER = (2, 4)


@dataclasses.dataclass(frozen=True)
class Task:
    """A motion of some duration, whose errors are asked for at some times."""

    system: AbstractSystem
    start: State
    args: Args
    t0: float
    duration: float
    times: Reals

    def rows(self, num_steps: int) -> tuple[int, NDArray[np.int_]]:
        """After how many steps a run saves that passes all times, and its rows there."""
        counts = num_steps * (self.times - self.t0) / self.duration
        whole = np.rint(counts).astype(int)
        # A time between steps would be measured against an interpolant.
        missed = (np.abs(counts - whole) > 1e-6) | (whole < 1) | (whole > num_steps)
        if missed.any():
            time = self.times[missed][0]
            raise ValueError(
                f"A run of {num_steps} steps from {self.t0:g} over {self.duration:g} does "
                f"not pass t = {time:g}, where the reference is given. Leave this time "
                "out, or choose numbers of steps of which one ends there."
            )
        every = math.gcd(num_steps, *whole.tolist())
        return every, whole // every

    def run(self, scheme: AbstractScheme, num_steps: int) -> Solution:
        """A run of a compiled program; a failure is left in its `result`."""
        h = jnp.asarray(self.duration / num_steps, self.start.q.dtype)
        t0 = jnp.asarray(self.t0, h.dtype)
        every, _ = self.rows(num_steps)
        start = State(self.start.q, self.start.v)
        solution = _run(self.system, scheme, start, self.args, h, t0, num_steps, every)
        return jax.block_until_ready(solution)


@eqx.filter_jit
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
    """Numbers of a motion at the times of a task; NaN where nothing is known."""

    q: Reals
    v: Reals
    multipliers: Reals
    energy: Reals


@dataclasses.dataclass(frozen=True)
class Reference:
    """The motion that errors are measured against, and how well it is known.

    The uncertainties are the changes by the last extrapolation; 0 for given data.
    """

    values: Values
    uncertainty: dict[str, float]


def extrapolated(task: Task, finest: int, scheme: AbstractScheme | None) -> Reference:
    """Two runs finer than the finest measured, extrapolated to `h = 0` (Richardson)."""
    forced = task.system.force is not None
    if scheme is None:
        scheme = EnergyPreserving() if forced else Composed(EnergyPreserving(), 6)
    order = min(scheme.order, 2) if forced else scheme.order
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


@eqx.filter_jit
def _balance(system: AbstractSystem, states: State, args: Args):
    def at(state: State):
        if not system.is_timed:
            state = State(state.q, state.v)
        model = make_model(system, state, args)
        inner = model.to_internal(state)
        return model.accelerations(inner)[1], system.energy(state, args)

    return jax.vmap(at)(states)


def given(task: Task, q: Reals, v: Reals | None) -> Reference:
    """From the user's own data."""
    if v is None:
        # Without velocities only positions can be compared.
        unknown = np.full((len(q), 1), np.nan)
        values = Values(q, unknown, unknown, unknown[:, 0])
    else:
        values = at_states(task, q, v)
    return Reference(values, dict(q=0.0, v=0.0, multipliers=0.0))
