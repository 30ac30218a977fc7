"""The strains of a potential, and their terms in the equations of a step.

A scheme that damps strains `Gamma(q)` adds `x . Gamma + y . dGamma/dt` to the energy, with
multipliers `x` and `y` that are constant in a step. Its discrete gradient is that of the
chain rule in the coordinates and their rates together. Both functions consist of
invariants where the strains do, and then the terms conserve linear and angular momentum.
(The discrete gradient of `eta . psi` in `separable.py` takes the two one after the other.
This has the same property for constraints that are quadratic, but not for any function.)

The rates enter `dGamma/dt` linearly, so the discrete gradient with respect to them depends
on the positions alone, and the velocities follow from it in closed form.
"""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._discrete import ChainRule, discrete_grad, discrete_jvp
from .._system import AbstractStrainEnergy, State
from .._types import Coordinates, Increments, Scalar, Velocities
from .base import row_scales
from .separable import SeparableModel


# Coordinates and their rates.
Motion: TypeAlias = tuple[Coordinates, Coordinates]


class Strains(eqx.Module):
    """The strains of the potential of a model, with velocities `v = qdot` or rotations."""

    model: SeparableModel

    @property
    def count(self) -> int:
        return jax.eval_shape(self.values, self.model.scales.coordinate).size

    def values(self, q: Coordinates) -> Float[Array, " ns"]:
        potential = self.model.system.potential
        if not isinstance(potential, AbstractStrainEnergy):
            return q[:0]
        parts = [x.ravel() for x in potential.strains(q, self.model.args)]
        return jnp.concatenate(parts) if parts else q[:0]

    def stresses(self, strains: Float[Array, " ns"]) -> Float[Array, " ns"]:
        """`K strains`"""
        potential = self.model.system.potential
        assert isinstance(potential, AbstractStrainEnergy)
        args, q = self.model.args, self.model.scales.coordinate
        like = jax.eval_shape(lambda q: potential.strains(q, args), q)
        _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like))
        parts = potential.stresses(unravel(strains), args)
        return jnp.concatenate([x.ravel() for x in parts])

    def change(
        self, qa: Coordinates, qb: Coordinates, displacement: Coordinates
    ) -> Float[Array, " ns"]:
        """`Gamma(qb) - Gamma(qa)`, without the cancellation of a difference."""
        return discrete_jvp(self.values, qa, qb)(displacement)

    def rates(self, q: Coordinates, v: Velocities) -> Float[Array, " ns"]:
        """`dGamma/dt`"""
        return jax.jvp(self.values, (q,), (self.model.lift(q, v),))[1]

    def momentum(self, q: Coordinates, y: Float[Array, " ns"]) -> Velocities:
        """The gradient of `y . dGamma/dt` with respect to the velocities."""
        rest = jnp.zeros((self.model.inertia.shape[0],), q.dtype)
        _, transpose = jax.vjp(lambda v: self.rates(q, v), rest)
        return transpose(y)[0]

    def mean_momentum(
        self, qa: Coordinates, qb: Coordinates, step: Increments, y: Float[Array, " ns"]
    ) -> Velocities:
        """The discrete gradient of `y . dGamma/dt` with respect to the velocities."""
        none = jnp.zeros_like(qa)
        energy, ends = self._energy(None, y), ((qa, none), (qb, none))
        rule = self.model.chain_rule(ChainRule(), step)
        if rule is not None:
            of_both = lambda x: energy(x[:2])
            return rule.gradient_by_rates(of_both, (qa, None), (qb, None))
        _, by_rates = discrete_grad(energy)(*ends)
        # The momenta of gradients with respect to rates are these themselves, except for
        # rotations, which do not use this function.
        return self.model.kinematics.momentum_of_rates(
            (qa, by_rates), (qb, by_rates), step, lambda q, by_rates: by_rates
        )

    def gradient(
        self,
        a: State,
        b: State,
        step: Increments,
        x: Float[Array, " ns"],
        y: Float[Array, " ns"],
    ) -> tuple[Coordinates, Increments | None]:
        """The discrete gradient of `x . Gamma + y . dGamma/dt` in the coordinates, and
        further rows of the balance of momentum."""
        at = lambda state: (state.q, self.model.lift(state.q, state.v))
        energy, rule = self._energy(x, y), self.model.chain_rule(ChainRule(), step)
        if rule is not None:
            of_both = lambda x: energy(x[:2])
            return a.q[:0], rule.gradient(of_both, (*at(a), None), (*at(b), None))[0]
        gradient, by_rates = discrete_grad(energy)(at(a), at(b))
        _, rows = self.model.kinematics.mean_rates(
            a, b, self.model.lift, lambda: ((a.q, by_rates), (b.q, by_rates))
        )
        return gradient, rows

    def scales(self, q: Coordinates) -> Float[Array, " ns"]:
        """The norms of the gradients of the strains in the metric of the inverse inertia.

        A strain without a gradient has the scale one.
        """
        norms, _ = row_scales(self.values, q, self.model.scales.coordinate)
        return jnp.where(norms > 0, norms, 1.0)

    def _energy(
        self, x: Float[Array, " ns"] | None, y: Float[Array, " ns"]
    ) -> Callable[[Motion], Scalar]:
        """`x . Gamma + y . dGamma/dt` of coordinates and their rates."""

        def energy(motion: Motion) -> Scalar:
            q, rates = motion
            values, changes = jax.jvp(self.values, (q,), (rates,))
            along = jnp.sum(y * changes)
            return along if x is None else jnp.sum(x * values) + along

        return energy
