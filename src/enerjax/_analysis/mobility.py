"""What a mechanism can do in one pose: its freedoms, and constraints that repeat others."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from .._operators import make_model
from .._solvers import as_dense
from .._system import AbstractSystem, check_system, State
from .._types import Args, Real


# Relative size below which a singular value counts as zero.
_RANK = 1e-8
# Residual, in parts of the size of a constraint, above which it is violated.
_MET = 1e-6


class Mobility(NamedTuple):
    """The freedoms of a system in one pose; see `mobility`.

    - `degrees_of_freedom`: independent velocities that the constraints admit.
    - `rank`: of the constraints; `num_constraints` if they are independent.
    - `num_constraints`: rows, joints first.
    - `redundant`: numbers (or names) of rows that follow from those before them.
    - `inconsistent`: rows, redundant or not, that are violated in this pose and that no
      small motion repairs together with the others.
    - `singular_values`: of the constraints scaled to order one, descending. A small one
      marks a pose close to a singular one.
    - `velocities`: columns are independent rates of the coordinates, `(nq, dof)`,
      orthonormal in the inertia.
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
            lines.append(f"violated, and not to be repaired: {named(self.inconsistent)}")
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
    """Counts the freedoms of a mechanism, and finds the constraints that repeat others.

    By the rank of `dPhi/dq` in the metric of the inertia, so that units do not matter. In
    a singular pose, where constraints lose their independence for an instant, it counts
    the freedoms of that instant.

    **Arguments:**

    - `system`, `state`, `args`: as for `simulate`. The constraints need not hold. Numbers,
      not traced values.
    - `t`: the time, for `driven` constraints.
    - `names`: of the rows of the constraints, joints first; their numbers by default.

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
    """`mobility`, with rows that stand `first`, before those that may follow from them."""
    state, args = check_system(system, state, args, t)
    scaled, root, residual = scaled_constraints(system, state, args)
    num_constraints, num_coordinates = scaled.shape
    if names is None:
        names = [str(k) for k in range(num_constraints)]
        label = lambda rows: tuple(int(k) for k in sorted(rows))
    else:
        given = list(names)
        if len(given) != num_constraints:
            raise ValueError(
                f"`mobility(names=...)`: {len(given)} names for {num_constraints} rows "
                "of constraints."
            )
        label = lambda rows: tuple(given[k] for k in sorted(rows))
    left, values, right = np.linalg.svd(scaled)
    rank = int(np.sum(values > _RANK))
    kept = independent_rows(scaled, first)
    # What no motion can repair: the part of the residual outside of the range.
    stuck = left[:, rank:] @ (left[:, rank:].T @ residual)
    return Mobility(
        degrees_of_freedom=num_coordinates - rank,
        rank=rank,
        num_constraints=num_constraints,
        redundant=label(set(range(num_constraints)) - set(kept)),
        inconsistent=label(np.nonzero(np.abs(stuck) > _MET)[0]),
        singular_values=values,
        velocities=scipy.linalg.solve_triangular(root.T, right[rank:].T),
    )


def independent_rows(scaled: np.ndarray, first: Sequence[int] = ()) -> list[int]:
    """Numbers of the rows that do not follow from those before them, `first` ahead of all.

    As many as the rank.
    """
    rank = int(np.sum(np.linalg.svd(scaled, compute_uv=False) > _RANK))
    rows = [*first, *(k for k in range(len(scaled)) if k not in set(first))]
    basis, count = np.zeros_like(scaled), 0
    own = np.zeros(len(scaled))  # the length of what is not in the rows before
    for k in rows:
        rest, before = scaled[k], basis[:count]
        for _ in range(2):  # once more for round-off
            rest = rest - (before @ rest) @ before
        own[k] = np.linalg.norm(rest)
        if own[k] > _RANK:
            basis[count] = rest / own[k]
            count += 1
    return sorted(np.argsort(-own, kind="stable")[:rank].tolist())


def scaled_constraints(
    system: AbstractSystem, state: State, args: Args
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`dPhi/dq` in units of the constraints and the inertia, the root of the inertia, and
    the residual in parts of the sizes of the constraints.

    Those are of their terms, and of the change that would come of moving the pose as far
    as it is from the origin: the terms of a constraint can vanish.
    """
    metric, jacobian, residual, size = map(np.asarray, _linearised(system, state, args))
    root = np.linalg.cholesky(metric)
    scaled = scipy.linalg.solve_triangular(root, jacobian.T, lower=True).T
    lengths = np.linalg.norm(scaled, axis=1)
    unit = np.where(lengths > 0, lengths, 1.0)
    size = size + lengths * np.linalg.norm(root.T @ np.asarray(state.q))
    return scaled / unit[:, None], root, residual / np.where(size > 0, size, 1.0)


@eqx.filter_jit
def _linearised(
    system: AbstractSystem, state: State, args: Args
) -> tuple[Array, Array, Array, Array]:
    """The inertia in the coordinates; the constraints: gradients, residuals, sizes."""
    model = make_model(system, state, args)
    metric = as_dense(model.metric(model.to_internal(state)))
    jacobian = jax.jacfwd(model.constraint)(state.q, state.t)
    residual = model.constraint(state.q, state.t)
    return metric, jacobian, residual, model.scales.constraint_size
