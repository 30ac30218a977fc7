"""What is measured: schemes on problems, at halving steps, against the references."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed, ThreadPoolExecutor

import numpy as np
import references
from references import Minimal, Reference

import enerjax as ej


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem, how long it runs, and in how many steps at the coarsest.

    `coarsest` is by the order of the scheme: a high order needs long steps to stay above
    round-off over two halvings, a low order short ones to be in its asymptotic regime.
    """

    name: str
    problem: Callable[[], ej.problems.Problem]
    minimal: Minimal
    end_time: float
    coarsest: dict[int, int]
    energy_scale: float
    energy_scale_name: str
    constrained: bool = True
    kinematics: bool = False


CASES = (
    Case(
        "spring pendulum",
        ej.problems.spring_pendulum,
        references.SPRING_PENDULUM,
        2.0,
        {2: 100, 3: 100, 4: 50, 6: 25, 8: 20},
        9.81,
        "m g l",
        constrained=False,
    ),
    Case(
        "pendulum, angle",
        ej.problems.pendulum_angle,
        references.PENDULUM_ANGLE,
        2.0,
        {2: 50, 3: 50, 4: 25, 6: 12, 8: 8},
        9.81,
        "m g l",
        constrained=False,
    ),
    Case(
        "pendulum",
        ej.problems.pendulum,
        references.PENDULUM,
        2.0,
        {2: 100, 3: 50, 4: 25, 6: 12, 8: 8},
        9.81,
        "m g l",
    ),
    Case(
        "double pendulum",
        ej.problems.double_pendulum,
        references.DOUBLE_PENDULUM,
        2.0,
        {2: 200, 3: 100, 4: 50, 6: 30, 8: 24},
        2 * 9.81 + 9.81,
        "g (m1 l1 + m2 (l1 + l2))",
    ),
    Case(
        "heavy top",
        ej.problems.heavy_top,
        references.HEAVY_TOP,
        0.2,
        {2: 100, 4: 50, 6: 30, 8: 25},
        5436.0,
        "kinetic energy at the start",
        kinematics=True,
    ),
)
QUICK_CASES = ("spring pendulum", "double pendulum")


@dataclasses.dataclass(frozen=True)
class Method:
    """A scheme as the table names it, and the order that theory gives it."""

    name: str
    scheme: ej.AbstractScheme
    expected: int


def methods(case: Case) -> Iterator[list[Method]]:
    """The schemes that are defined on a problem; those of a group share one program.

    Each scheme is listed once. Without constraints the two formulations are one, and so
    are `KappaDecaying` and `EnergyDecaying`; the two discrete gradients differ only
    where V or Phi is more than quadratic in more than one coordinate.
    """
    preserving = "EnergyPreserving"
    yield [Method(preserving, ej.EnergyPreserving(), 2)]
    if case.constrained:
        yield [Method(f"{preserving} index3", ej.EnergyPreserving("index3"), 2)]
    free = 2 if case.constrained or case.name == "spring pendulum" else 3
    yield [
        Method(f"EnergyDecaying({a})", ej.EnergyDecaying(a), free) for a in (0.5, 1.0)
    ]
    if case.constrained:
        yield [
            Method(f"EnergyDecaying({a}) index3", ej.EnergyDecaying(a, "index3"), 2)
            for a in (0.5, 1.0)
        ]
        yield [Method("KappaDecaying(0.5)", ej.KappaDecaying(0.5), 2)]
    if case.name == "spring pendulum":
        mean = ej.MeanValue()
        yield [
            Method(f"EnergyDecaying({a}) MeanValue", ej.EnergyDecaying(a, derivative=mean), 3)
            for a in (0.5, 1.0)
        ]
    if not case.kinematics:
        yield [
            Method(f"EnergyConsistent({a})", ej.EnergyConsistent(a), 3 if a else 4)
            for a in (0.0, 0.5, 1.0)
        ]
    for order in (4, 6, 8):
        scheme = ej.Composed(ej.EnergyPreserving(), order)
        yield [Method(f"Composed({preserving}, {order})", scheme, order)]
    if not case.kinematics:
        for order in (6, 8):
            scheme = ej.Composed(ej.EnergyConsistent(0.0), order)
            yield [Method(f"Composed(EnergyConsistent(0), {order})", scheme, order)]


@dataclasses.dataclass(frozen=True)
class Run:
    """One run to the end time; the errors are NaN if it failed on the way."""

    h: float
    error_q: float
    error_v: float
    energy_error: float
    identity_error: float
    constraint: float
    constraint_rate: float
    newton_iterations: float
    failure: str


def run(
    case: Case,
    problem: ej.problems.Problem,
    method: Method,
    reference: Reference,
    blocks: int,
) -> Run:
    """The run in `blocks` times the coarsest number of steps.

    It is done in as many calls of the same number of steps. `h` and the start are
    traced, so all steps of a scheme share one compilation.
    """
    num_steps = case.coarsest[method.expected]
    h = case.end_time / (num_steps * blocks)
    system, state, args = problem
    energy0, removed, failure = float(system.energy(state, args)), 0.0, ""
    energy_error = identity_error = constraint = rate = 0.0
    iterations = []
    for block in range(blocks):
        solution = ej.simulate(
            system, method.scheme, state, args, h=h, num_steps=num_steps, throw=False
        )
        done = int(solution.stats.completed_steps)
        audit = solution.audit
        change = np.asarray(audit.energy)[: done + 1] - energy0
        dissipated = removed + np.cumsum(audit.dissipated)[: done + 1]
        removed = dissipated[-1]
        energy_error = max(energy_error, _largest(change))
        identity_error = max(identity_error, _largest(change + dissipated))
        constraint = max(constraint, _largest(audit.constraint[: done + 1]))
        rate = max(rate, _largest(audit.constraint_rate[: done + 1]))
        iterations.append(np.asarray(solution.stats.newton_iterations)[:done])
        if done < num_steps:
            cause = ej.RESULTS[solution.result].split(".")[0].split(":")[0]
            failure = f"t = {(block * num_steps + done) * h:.4g}: {cause}"
            break
        state = ej.State(solution.ys.q[-1], solution.ys.v[-1])
    error_q = math.nan if failure else _largest(state.q - reference.q)
    error_v = math.nan if failure else _largest(state.v - reference.v)
    solves = np.concatenate(iterations) / len(method.scheme.stages)
    return Run(
        h,
        error_q,
        error_v,
        energy_error / case.energy_scale,
        identity_error / case.energy_scale,
        constraint,
        rate,
        float(solves.mean()) if solves.size else math.nan,
        failure,
    )


def _largest(x) -> float:
    return float(np.abs(np.asarray(x)).max(initial=0.0))
