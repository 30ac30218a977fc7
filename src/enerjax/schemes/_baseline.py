"""What the schemes that are here for comparison have in common."""

from collections.abc import Callable

import equinox as eqx
import jax

from .._discrete import ChainRule
from .._operators import AbstractModel, Increment, SeparableModel
from .._system import State
from .._types import Coordinates, Multipliers, Scalar
from .base import Formulation, Law, StepProblem
from .energies import Energies


def plain_problem(
    scheme: str, model: AbstractModel, start: State, h: Scalar, formulation: Formulation
) -> StepProblem:
    """The data of a step; raises for a system that the scheme is not defined for."""
    if isinstance(model, SeparableModel) and model.has_canonical_rates:
        # No discrete gradient is taken.
        return StepProblem(model, start, h, ChainRule(), formulation)
    has = "varying inertia or a Hamiltonian"
    if isinstance(model, SeparableModel):
        has = "`kinematics`"
    raise ValueError(
        f"`{scheme}` needs constant inertia and velocities that are the rates of the "
        f"coordinates, and this system has {has}. Use `EnergyPreserving` or "
        "`EnergyDecaying`, or compare on points, directors (`bodies.RigidBody`) or planar "
        "bodies."
    )


def model_of(problem: StepProblem) -> SeparableModel:
    """The model, of which `plain_problem` knows the kind."""
    assert isinstance(problem.model, SeparableModel)
    return problem.model


def reaction_force(
    model: AbstractModel, q: Coordinates, t: Scalar | None, multipliers: Multipliers
) -> Coordinates:
    """`B(q, t)^T multipliers`"""
    _, transpose = jax.vjp(lambda q: model.constraint(q, t), q)
    return transpose(multipliers)[0]


def measured_account(
    problem: StepProblem,
    end: State,
    work: Callable[[Law], Scalar],
    drive_work: Scalar | None,
) -> Energies:
    """As removed by the scheme the energy that is missing, which no identity explains."""
    model, start = problem.model, problem.start
    energy = lambda state: model.kinetic(state) + model.potential(state)
    account = problem.account(energy(start) - energy(end), work, drive_work)
    loss = account.dissipated
    for supplied in (account.work, drive_work):
        loss = loss if supplied is None else loss + supplied
    return eqx.tree_at(lambda account: account.dissipated, account, loss)


def balance_rows(
    problem: StepProblem, impulse: Coordinates, z: Increment, end: State
) -> Increment:
    """A balance of momentum, and the constraints at the end of the step."""
    return Increment(
        problem.model.constraint(end.q, end.t) / problem.h,
        impulse,
        z.momentum,
        problem.joint_rate(end),
    )
