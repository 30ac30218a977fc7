"""The discrete operators of an interval `a -> b`, of which every scheme is made.

The structure residual of an interval driven by `(w_q, w_mu)` is (design: one `L` and a
skew `G` per interval, so that the two rows give the energy identity)

    S_q  = Lm^T M (v_b - v_a) + G(q_m, M v_m) (q_b - q_a) + h w_q
    S_mu = Lm (q_b - q_a) - h w_mu

at `q_m = (q_a + q_b)/2`, `v_m = (v_a + v_b)/2`. The drive is the discrete gradient of

    H = 1/2 v . M v + V(q) + lambda . Phi(q) + eta . psi(q, v)

with respect to `q` and to the momentum. `psi = C(q) v` is linear in `v`, so its joint
difference splits without any metric between positions and momenta,

    psi_b - psi_a = [D_q (C v_m)] (q_b - q_a) + 1/2 (C_a + C_b) (v_b - v_a),

which leaves `S_mu` free of the velocities at its end: schemes solve it for them.
"""

import equinox as eqx
import jax

from ._discrete import AbstractDerivative
from ._model import Model
from ._types import (
    Coordinates,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)


class Increment(eqx.Module):
    """The unknowns that lead to one node of a step, and the rows that determine them.

    | field | as unknown | as row |
    |---|---|---|
    | `rate` | `(q - q0)/h` | balance of momentum |
    | `impulse` | `h lambda` | `Phi(q)/h` |
    | `velocity_impulse` | `eta` | `psi(q, v)`; empty for index 3 |

    The rate and not `q` is the unknown: the rounding of `q`, divided by `h`, would
    otherwise enter the velocities. Each unknown and its row have reciprocal units, so
    one set of `Scales` serves both.
    """

    rate: Coordinates
    impulse: Multipliers
    velocity_impulse: JointMultipliers


class Segment(eqx.Module):
    """The interval between the configurations `qa` and `qb`."""

    model: Model
    derivative: AbstractDerivative
    qa: Coordinates
    qb: Coordinates

    def push(self, rate: Coordinates) -> Velocities:
        """`Lm rate`"""
        return self.model.push(self._middle(), rate)

    def momentum(self, va: Velocities, vb: Velocities, dq: Coordinates) -> Coordinates:
        """`Lm^T M (vb - va) + G(q_m, M v_m) dq`"""
        middle = self._middle()
        change = self.model.pull(middle, self.model.inertia @ (vb - va))
        gyroscopic = self.model.gyroscopic(middle, 0.5 * (va + vb), dq)
        return change if gyroscopic is None else change + gyroscopic

    def impulse(
        self, h: Scalar, increment: Increment, mean_velocity: Velocities
    ) -> Coordinates:
        """`h D_q H`: the discrete gradient of `h V + (h lambda) . Phi + h eta . psi`."""

        def action(q: Coordinates) -> Scalar:
            out = h * self.model.potential(q)
            if increment.impulse.size > 0:
                out = out + increment.impulse @ self.model.constraint(q)
            if increment.velocity_impulse.size > 0:
                rate = self.model.joint_rate(q, mean_velocity)
                out = out + h * increment.velocity_impulse @ rate
            return out

        return self.derivative.gradient(action, self.qa, self.qb)

    def reaction(self, eta: JointMultipliers) -> Velocities | float:
        """`D_mu (eta . psi) = 1/2 M^-1 (C_a + C_b)^T eta`, a velocity."""
        a, b = (reaction(self.model, q, eta) for q in (self.qa, self.qb))
        return 0.5 * (a + b)

    def _middle(self) -> Coordinates:
        return 0.5 * (self.qa + self.qb)


def reaction(model: Model, q: Coordinates, eta: JointMultipliers) -> Velocities | float:
    """`M^-1 C(q)^T eta`: the velocity that velocity-level multipliers cause at `q`."""
    if eta.size == 0:
        return 0.0
    rest = jax.numpy.zeros(model.inertia.shape[0], q.dtype)
    # psi is linear in v, so its transpose is the same at every v.
    _, transpose = jax.vjp(lambda v: model.joint_rate(q, v), rest)
    return model.inverse_inertia @ transpose(eta)[0]
