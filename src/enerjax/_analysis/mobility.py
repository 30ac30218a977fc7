"""Degrees of freedom of a mechanism in one pose, and constraints that are redundant."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Array, Float

from .._operators import make_model
from .._programs import compiled
from .._solvers import as_dense
from .._system import AbstractSystem, check_system, State
from .._types import Args, Real


# Smaller singular values of the scaled constraints count as zero: half the digits.
_RANK = 1e-8
# A constraint is violated if its residual exceeds this fraction of its size.
_VIOLATED = 1e-6


class Mobility(NamedTuple):
    """The degrees of freedom of a system in one pose; see `mobility`.

    - `degrees_of_freedom`: the number of independent velocities that are admissible.
    - `rank`: of the constraint Jacobian.
    - `num_constraints`: equals the rank if the constraints are independent.
    - `redundant`: constraints that follow from those before them, by index or name.
    - `inconsistent`: constraints, redundant or not, that are violated in this pose, and
      that no small motion can repair together with the others.
    - `singular_values`: of the scaled constraint Jacobian, descending. The pose is close
      to a singular one if the smallest is small.
    - `velocities`: independent admissible rates of the coordinates as columns, shape
      `(nq, dof)`, orthonormal in the inertia.
    """

    degrees_of_freedom: int
    rank: int
    num_constraints: int
    redundant: tuple
    inconsistent: tuple
    singular_values: Float[np.ndarray, " rank"]
    velocities: Float[np.ndarray, "nq dof"]

    def __str__(self) -> str:
        named = lambda rows: ", ".join(map(str, rows))
        lines = [
            f"{self.degrees_of_freedom} degrees of freedom, {self.rank} independent of "
            f"{self.num_constraints} constraints"
        ]
        if self.redundant:
            lines.append(f"follow from others: {named(self.redundant)}")
        if self.inconsistent:
            lines.append(f"violated, and cannot be repaired: {named(self.inconsistent)}")
        if self.rank:
            least = self.singular_values[self.rank - 1]
            lines.append(f"smallest singular value {least:.2g}: small near singular poses")
        return "\n".join(lines)


def mobility(
    system: AbstractSystem,
    state: State,
    args: Args = None,
    *,
    t: Real = 0.0,
    names: Sequence[str] | None = None,
) -> Mobility:
    """Counts the degrees of freedom of a mechanism, and finds redundant constraints.

    The count follows from the rank of `dPhi/dq` in the metric of the inertia, so that units
    do not matter. In a singular pose, where constraints lose their independence for an
    instant, the additional instantaneous freedoms are counted too.

    **Arguments:**

    - `system`, `state`, `args`: as for `simulate`, but not traced. The constraints need
      not hold.
    - `t`: the time, for `driven` constraints.
    - `names`: of the constraints, joints first; their indices by default.

    **Returns:** a `Mobility`.

    **Raises:** `ValueError` for bad input, and for a wrong number of names.
    """
    return freedoms(system, state, args, t, names, ())


def freedoms(
    system: AbstractSystem,
    state: State,
    args: Args,
    t: Real,
    names: Sequence[str] | None,
    first: Sequence[int],
) -> Mobility:
    """`mobility`, where the rows in `first` count before all others."""
    state, args, _ = check_system(system, state, args, t)
    scaled, root, residual = scaled_constraints(system, state, args)
    num_constraints, num_coordinates = scaled.shape
    if names is None:
        names = [str(k) for k in range(num_constraints)]
        label = lambda rows: tuple(int(k) for k in sorted(rows))
    else:
        labels = list(names)
        if len(labels) != num_constraints:
            raise ValueError(
                f"`mobility(names=...)`: {len(labels)} names for {num_constraints} "
                "constraints."
            )
        label = lambda rows: tuple(labels[k] for k in sorted(rows))
    left, values, right = np.linalg.svd(scaled)
    rank = int(np.sum(values > _RANK))
    kept = independent_rows(scaled, first)
    # No motion can repair the part of the residual outside of the range of the Jacobian.
    unrepaired = left[:, rank:] @ (left[:, rank:].T @ residual)
    return Mobility(
        degrees_of_freedom=num_coordinates - rank,
        rank=rank,
        num_constraints=num_constraints,
        redundant=label(set(range(num_constraints)) - set(kept)),
        inconsistent=label(np.nonzero(np.abs(unrepaired) > _VIOLATED)[0]),
        singular_values=values,
        velocities=scipy.linalg.solve_triangular(root.T, right[rank:].T),
    )


def independent_rows(scaled: np.ndarray, first: Sequence[int] = ()) -> list[int]:
    """As many rows as the rank that do not follow from those before them.

    The rows in `first` count before all others.
    """
    rank = int(np.sum(np.linalg.svd(scaled, compute_uv=False) > _RANK))
    rows = [*first, *(k for k in range(len(scaled)) if k not in set(first))]
    basis, count = np.zeros_like(scaled), 0
    distance = np.zeros(len(scaled))  # of a row from the span of the rows before it
    for k in rows:
        rest, before = scaled[k], basis[:count]
        for _ in range(2):  # the second pass removes round-off
            rest = rest - (before @ rest) @ before
        distance[k] = np.linalg.norm(rest)
        if distance[k] > _RANK:
            basis[count] = rest / distance[k]
            count += 1
    return sorted(np.argsort(-distance, kind="stable")[:rank].tolist())


def scaled_constraints(
    system: AbstractSystem, state: State, args: Args
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The scaled constraint Jacobian, the Cholesky factor of the inertia, and the residual
    of each constraint as a fraction of its size.

    The rows of the Jacobian have unit length in the inverse inertia. The size of a
    constraint is that of its terms, plus its change when the pose moves as far as the
    origin is away: all of its terms may vanish.
    """
    metric, jacobian, residual, size = map(np.asarray, _linearised(system, state, args))
    root = np.linalg.cholesky(metric)
    scaled = scipy.linalg.solve_triangular(root, jacobian.T, lower=True).T
    lengths = np.linalg.norm(scaled, axis=1)
    unit = np.where(lengths > 0, lengths, 1.0)
    size = size + lengths * np.linalg.norm(root.T @ np.asarray(state.q))
    return scaled / unit[:, None], root, residual / np.where(size > 0, size, 1.0)


@compiled
def _linearised(
    system: AbstractSystem, state: State, args: Args
) -> tuple[Array, Array, Array, Array]:
    """The inertia in the coordinates; Jacobian, residuals and sizes of the constraints."""
    model = make_model(system, state, args)
    metric = as_dense(model.metric(model.to_internal(state)))
    near = model.constraint_near(state.q, state.t)
    jacobian, residual = jax.jacfwd(near)(state.q), near(state.q)
    return metric, jacobian, residual, model.scales.constraint_size
