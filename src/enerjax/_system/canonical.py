"""Systems with any kinetic energy, which schemes integrate in `q` and momenta `p`."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import call_traced_once
from .._solvers import inverse, solve_definite
from .._types import Args, Coordinates, Scalar, Velocities
from .base import (
    AbstractSystem,
    check_function,
    check_functions,
    Constraint,
    Driven,
    Force,
    Nonholonomic,
    Potential,
    State,
    Symmetry,
)
from .names import Names


class AbstractCanonicalSystem(AbstractSystem):
    """A system with a Hamiltonian `H(q, p)`."""

    @abc.abstractmethod
    def hamiltonian_at(self, q: Coordinates, p: Coordinates, args: Args) -> Scalar:
        """`H(q, p)`"""

    @abc.abstractmethod
    def rate(self, q: Coordinates, p: Coordinates, args: Args) -> Coordinates:
        """`qdot = dH/dp`"""

    @abc.abstractmethod
    def inverse_inertia(
        self, q: Coordinates, p: Coordinates, args: Args
    ) -> Float[Array, "nq nq"]:
        """`d2H/dp2`, which can be singular for a general Hamiltonian."""

    @abc.abstractmethod
    def masses(self, q: Coordinates, p: Coordinates, args: Args) -> Coordinates:
        """A mass for each coordinate, by which increments of `q` and `p` are compared."""

    @abc.abstractmethod
    def momentum(self, state: State, args: Args) -> Coordinates:
        """The momenta `p` of a user's state."""

    @abc.abstractmethod
    def velocity(self, q: Coordinates, p: Coordinates, args: Args) -> Velocities:
        """The `v` of the state that is returned to the user."""


class LagrangianSystem(AbstractCanonicalSystem):
    """A system whose inertia depends on its coordinates: `System.from_lagrangian`."""

    kinetic: Callable[[Coordinates, Velocities, Args], Scalar]
    potential: Potential
    constraint: Constraint | None = None
    force: Force | None = None
    driven: Driven | None = None
    nonholonomic: Nonholonomic | None = None
    symmetry: Symmetry | None = None
    redundant: bool = eqx.field(default=False, static=True)
    names: Names | None = None
    events: tuple = ()

    def __check_init__(self):
        check_function("kinetic", self.kinetic, "(q, qdot, args)")
        check_functions(self, required="potential")

    def kinetic_energy(self, state: State, args: Args = None) -> Scalar:
        return call_traced_once(self.kinetic, state.q, state.v, args)

    def potential_energy(self, state: State, args: Args = None) -> Scalar:
        return call_traced_once(self.potential, state.q, args)

    def energy(self, state: State, args: Args = None) -> Scalar:
        return self.kinetic_energy(state, args) + self.potential_energy(state, args)

    def inertia(self, state: State, args: Args) -> Float[Array, "nq nq"]:
        rest = jnp.zeros_like(state.q)
        return jax.hessian(lambda qdot: self.kinetic_energy(State(state.q, qdot), args))(
            rest
        )

    def hamiltonian_at(self, q, p, args):
        rate = self.velocity(q, p, args)
        energies = lambda q, rate, args: (
            self.kinetic_energy(State(q, rate), args),
            self.potential_energy(State(q, rate), args),
        )
        args = _with_arrays(args)
        # The functions of the user may close over traced numbers.
        energies = eqx.filter_closure_convert(energies, q, rate, args)
        return _legendre_transform(energies, rate, q, p, args)

    def rate(self, q, p, args):
        return self.velocity(q, p, args)

    def inverse_inertia(self, q, p, args):
        return inverse(self.inertia(State(q, p), args))

    def masses(self, q, p, args):
        return jnp.diagonal(self.inertia(State(q, p), args))

    def momentum(self, state: State, args: Args) -> Coordinates:
        return jax.grad(lambda qdot: self.kinetic_energy(State(state.q, qdot), args))(
            state.v
        )

    def velocity(self, q: Coordinates, p: Coordinates, args: Args) -> Velocities:
        return solve_definite(self.inertia(State(q, p), args), p)


def _with_arrays(args: Args) -> Args:
    """`args` with arrays of JAX in place of other numbers.

    A function that `filter_closure_convert` has returned takes the kinds of arguments that
    it was converted with, and under `jax.grad` a Python number becomes traced.
    """
    convert = lambda x: jnp.asarray(x) if isinstance(x, float | np.ndarray) else x
    return jax.tree.map(convert, args)


@eqx.filter_custom_jvp
def _legendre_transform(
    energies: Callable[[Coordinates, Velocities, Args], tuple[Scalar, Scalar]],
    rate: Velocities,
    q: Coordinates,
    p: Coordinates,
    args: Args,
) -> Scalar:
    """`H(q, p) = p . qdot - T(q, qdot) + V(q)` at the rate `qdot` that belongs to `p`."""
    _, potential = energies(q, rate, _with_arrays(args))
    return 0.5 * p @ rate + potential


@_legendre_transform.def_jvp
def _legendre_transform_jvp(primals, tangents):
    # `p . qdot - T` is stationary in the rate, so neither the inertia nor its inverse is
    # differentiated.
    energies, rate, q, p, args = primals
    args = _with_arrays(args)
    t_energies, _, t_q, t_p, t_args = tangents
    values, rates = eqx.filter_jvp(
        lambda energies, q, args: energies(q, rate, args),
        (energies, q, args),
        (t_energies, t_q, t_args),
    )
    # The rate of an energy that does not depend on what moves is `None`.
    pairs = zip(values, rates, strict=True)
    kinetic, potential = (jnp.zeros_like(x) if dx is None else dx for x, dx in pairs)
    change = potential - kinetic
    change = change if t_p is None else change + rate @ t_p
    return _legendre_transform(energies, rate, q, p, args), change


class HamiltonianSystem(AbstractCanonicalSystem):
    """A system given by its Hamiltonian: `System.from_hamiltonian`."""

    hamiltonian: Callable[[Coordinates, Coordinates, Args], Scalar]
    constraint: Constraint | None = None
    force: Force | None = None
    driven: Driven | None = None
    nonholonomic: Nonholonomic | None = None
    symmetry: Symmetry | None = None
    redundant: bool = eqx.field(default=False, static=True)
    names: Names | None = None
    events: tuple = ()

    def __check_init__(self):
        check_functions(self, required="hamiltonian")

    def kinetic_energy(self, state: State, args: Args = None) -> Scalar:
        """`H(q, p) - H(q, 0)`"""
        return self.energy(state, args) - self.potential_energy(state, args)

    def potential_energy(self, state: State, args: Args = None) -> Scalar:
        """`H(q, 0)`"""
        return call_traced_once(self.hamiltonian, state.q, jnp.zeros_like(state.v), args)

    def energy(self, state: State, args: Args = None) -> Scalar:
        return call_traced_once(self.hamiltonian, state.q, state.v, args)

    def inertia(self, state: State, args: Args) -> Float[Array, "nq nq"]:
        return inverse(self.inverse_inertia(state.q, state.v, args))

    def inverse_inertia(self, q, p, args):
        return jax.hessian(self.hamiltonian_at, argnums=1)(q, p, args)

    def masses(self, q, p, args):
        return 1 / jnp.diagonal(self.inverse_inertia(q, p, args))

    def hamiltonian_at(self, q, p, args):
        return call_traced_once(self.hamiltonian, q, p, args)

    def rate(self, q, p, args):
        return jax.grad(self.hamiltonian_at, argnums=1)(q, p, args)

    def momentum(self, state: State, args: Args) -> Coordinates:
        return state.v

    def velocity(self, q: Coordinates, p: Coordinates, args: Args) -> Velocities:
        return p
