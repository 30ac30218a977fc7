"""Energies, momenta and constraint residuals along a run, by which to judge it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import AbstractModel
from .._programs import is_known
from .._system import State
from .._types import Scalar
from ..schemes import Energies


class Audit(eqx.Module):
    """The energy and the constraints at each saved time of a run.

    `print(solution.audit)` shows a summary. "Since the row before" means: summed over the
    steps between two saved times; such entries are 0 in row 0.

    - `kinetic`, `potential`, `energy`: shape `(times,)` (energy).
    - `dissipated`: shape `(times,)`, the energy that the scheme removed since the row
      before, according to its energy identity.
    - `work`, `drive_work`: shape `(times,)`, the work of `force` (including dampers) and of
      `driven` constraints on the system since the row before. Joints do no work: their
      discrete gradient is orthogonal to the displacement.
    - `damped`: shape `(times,)`, the energy that dampers removed since the row before:
      minus the work of `(f(q, v, t) - f(q, -v, t))/2`, the part of `force` that changes its
      sign with the velocity.
    - `impact`: shape `(times,)`, the energy that impacts and resets of events removed since
      the row before.
    - `leak`: shape `(times,)`, the change of the energy that the others do not explain,
      `energy[k] = energy[k-1] + work[k] + drive_work[k] - dissipated[k] - impact[k] +
      leak[k]`. It consists of round-off, the residual of Newton's method, and the error of
      schemes without an energy identity. If it is far above round-off, do not trust the
      run.
    - `momentum`: shape `(times, ns)`, of each `symmetry` of the system.
    - `constraint`: shape `(times, nh)`, residuals of joints, driven constraints and
      relations between coordinates, each in its own unit.
    - `constraint_rate`: shape `(times, nj)`, residuals of joints, driven and nonholonomic
      constraints at velocity level.
    """

    kinetic: Float[Array, " times"]
    potential: Float[Array, " times"]
    dissipated: Float[Array, " times"]
    work: Float[Array, " times"]
    damped: Float[Array, " times"]
    drive_work: Float[Array, " times"]
    impact: Float[Array, " times"]
    momentum: Float[Array, "times ns"]
    constraint: Float[Array, "times nh"]
    constraint_rate: Float[Array, "times nj"]

    @property
    def energy(self) -> Float[Array, " times"]:
        return self.kinetic + self.potential

    @property
    def leak(self) -> Float[Array, " times"]:
        change = jnp.diff(self.energy, prepend=self.energy[..., :1])
        return change - self.work - self.drive_work + self.dissipated + self.impact

    def __str__(self) -> str:
        return _report(self) if is_known(self) else repr(self)


class Measures(eqx.Module):
    """The entries of an `Audit` that belong to one state."""

    kinetic: Scalar
    potential: Scalar
    momentum: Float[Array, " ns"]
    constraint: Float[Array, " nh"]
    constraint_rate: Float[Array, " nj"]


def measures(model: AbstractModel, state: State) -> Measures:
    return Measures(
        kinetic=model.kinetic(state),
        potential=model.potential(state),
        momentum=model.symmetry_momenta(state),
        constraint=model.constraint(state.q, state.t),
        constraint_rate=model.joint_rate(state.q, state.v, state.t),
    )


def audit(rows: Measures, energies: Energies) -> Audit:
    """The audit of rows and of the energies between them, both with a leading time axis."""
    # In rows that are NaN this zero is NaN too.
    none = 0 * energies.dissipated
    return Audit(
        kinetic=rows.kinetic,
        potential=rows.potential,
        dissipated=energies.dissipated,
        work=none if energies.work is None else energies.work,
        damped=none if energies.damped is None else energies.damped,
        drive_work=none if energies.drive_work is None else energies.drive_work,
        impact=none if energies.impact is None else energies.impact,
        momentum=rows.momentum,
        constraint=rows.constraint,
        constraint_rate=rows.constraint_rate,
    )


def _report(audit: Audit) -> str:
    """One line for each entry; for a batch, that of its worst lane."""
    rows = np.isfinite(np.asarray(audit.energy))
    kept = lambda x: np.where(rows, np.asarray(x), 0.0)
    total = lambda x: _worst(np.sum(kept(x), axis=-1))
    largest = lambda x: np.nanmax(np.abs(np.asarray(x)), initial=0.0)
    momentum = np.asarray(audit.momentum)
    lines = [
        ("energy, change over the run", _worst(_last(audit.energy) - audit.energy[..., 0])),
        ("  removed by the scheme", total(audit.dissipated)),
        ("  work of forces", total(audit.work)),
        ("    of these, taken by dampers", total(audit.damped)),
        ("  work of drives", total(audit.drive_work)),
        ("  removed by impacts and resets", total(audit.impact)),
        ("  unaccounted for (sum)", total(audit.leak)),
        ("  unaccounted for (largest row)", largest(audit.leak)),
        ("largest kinetic energy", largest(audit.kinetic)),
        ("constraints, largest residual", largest(audit.constraint)),
        ("  of velocities", largest(audit.constraint_rate)),
    ]
    for k in range(momentum.shape[-1]):
        drift = momentum[..., k] - momentum[..., :1, k]
        lines.append((f"momentum {k}, largest change", largest(drift)))
    done = rows.sum(axis=-1)
    what = f"{rows.shape[-1]} rows" + (
        "" if rows.all() else f", {done.min()} of them reached"
    )
    if rows.ndim > 1:
        what += f", the worst of {rows[..., 0].size} runs"
    width = max(len(name) for name, _ in lines)
    return "\n".join([what, *(f"{name:{width}}  {x: .3e}" for name, x in lines)])


def _last(x: Array) -> np.ndarray:
    """The last entry of each lane that is not NaN."""
    last = np.isfinite(np.asarray(x)).sum(axis=-1) - 1
    return np.take_along_axis(np.asarray(x), last[..., None], axis=-1)[..., 0]


def _worst(x: np.ndarray) -> float:
    flat = np.ravel(x)
    return float(flat[np.argmax(np.abs(flat))])
