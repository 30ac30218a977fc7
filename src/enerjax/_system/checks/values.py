"""Checks of the values of a system: finite energies, a regular inertia."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._programs import call_traced_once, compiled_for_once, is_known, values_of
from ..._solvers import is_positive_definite, scaled_blocks, Symmetric
from ..._types import Args, Flag
from ..base import AbstractSystem, State
from ..canonical import HamiltonianSystem, LagrangianSystem
from ..separable import System
from .shapes import describe, energies


def direction_without_symmetry(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """A direction along which a function that depends on `x` is unlikely to be constant."""
    return 1 + 0.5 * jnp.cos(jnp.arange(x.size, dtype=x.dtype))


# The conditions that the values of a system must satisfy, in the order of their messages.
# `check_without_rotations` has the message of the last one.
_CONDITIONS = (
    "start args potential timed slope constraint slopes nonholonomic acts depends "
    "inertia quadratic symmetric definite rigid regular"
).split()


@compiled_for_once
def _facts(system: AbstractSystem, state: State, args: Args) -> Bool[Array, " conditions"]:
    """Whether each of `_CONDITIONS` is satisfied.

    All functions of the user are called here; see `closes_over_traced_values`.
    """
    inertia = system.inertia(state, args)
    blocks, eps = scaled_blocks(inertia), 1e3 * jnp.finfo(inertia.dtype).eps
    finite = lambda tree: jnp.all(
        jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)], bool)
    )
    constraints = [system.constraint]
    if isinstance(system, System):
        constraints.append(system.coordinate_constraint)
    potential = lambda q: system.potential_energy(State(q, jnp.zeros_like(state.v)), args)
    rows_of = [
        lambda q, fn=fn: call_traced_once(fn, q, args)
        for fn in constraints
        if fn is not None
    ]
    # A row that depends on `q` changes along this direction.
    along = direction_without_symmetry(state.q)
    rates = [jax.jvp(fn, (state.q,), (along,))[1] for fn in rows_of]
    slopes = jnp.concatenate([jnp.zeros((0,), state.q.dtype), *rates])
    timed, t = [], state.t
    if system.force is not None and t is not None:
        timed.append(call_traced_once(system.force, state.q, state.v, t, args))
    if system.driven is not None and t is not None:
        timed.append(call_traced_once(system.driven, state.q, t, args))
    facts: dict[str, Any] = dict(
        **_nonholonomic(system, state, args),
        start=finite(state),
        args=finite([x for x in jax.tree.leaves(args) if eqx.is_inexact_array(x)]),
        potential=finite(system.potential_energy(state, args)),
        timed=finite(timed),
        constraint=finite([rows(state.q) for rows in rows_of]),
        slope=finite(jax.grad(potential)(state.q)),
        slopes=finite(slopes),
        depends=jnp.array(system.redundant) | jnp.all(slopes != 0),
        inertia=finite(inertia),
        quadratic=_is_quadratic(system, state, inertia, args),
        symmetric=jnp.all(jnp.abs(blocks - jnp.swapaxes(blocks, 1, 2)) <= eps),
        **_definiteness(system, inertia),
        rigid=_is_rigid(system, state, inertia, args),
    )
    return jnp.stack([facts[name] for name in _CONDITIONS])


def _nonholonomic(system: AbstractSystem, state: State, args: Args) -> dict[str, Flag]:
    """Whether the rows of the matrix of these constraints are finite, and none is zero."""
    if system.nonholonomic is None:
        return dict(nonholonomic=jnp.array(True), acts=jnp.array(True))
    matrix = system.nonholonomic(state.q, args)
    return dict(
        nonholonomic=jnp.all(jnp.isfinite(matrix)),
        acts=jnp.array(system.redundant) | jnp.all(jnp.any(matrix != 0, axis=1)),
    )


def _definiteness(system: AbstractSystem, inertia: Symmetric) -> dict[str, Flag]:
    """Whether each velocity that the coordinates can have has a positive energy, and
    whether no rigid body is flat."""
    if not isinstance(system, System):
        return dict(definite=is_positive_definite(inertia), regular=jnp.array(True))
    # Moments of inertia are known to nine digits, or to the round-off of their dtype.
    rounding = max(1e-9, 1e3 * float(jnp.finfo(inertia.dtype).eps))
    kind = system.kinematics
    return dict(
        definite=kind.is_definite(inertia, rounding),
        regular=kind.is_regular(inertia, rounding),
    )


def has_valid_energy(system: AbstractSystem, state: State, args: Args) -> Flag:
    """Whether the kinetic energy is one that schemes can use; for traced numbers too."""
    system, state, args = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, (system, state, args)
    )
    inertia = system.inertia(state, args)
    blocks, eps = scaled_blocks(inertia), 1e3 * jnp.finfo(inertia.dtype).eps
    symmetric = jnp.all(jnp.abs(blocks - jnp.swapaxes(blocks, 1, 2)) <= eps)
    valid = symmetric & _definiteness(system, inertia)["definite"]
    if not isinstance(system, HamiltonianSystem):
        valid = valid & _has_form(system, state, args)
    valid = valid & _is_rigid(system, state, inertia, args)
    # A number that is not finite is told by the first step.
    return valid | ~jnp.all(jnp.isfinite(blocks))


def _has_form(system: AbstractSystem, state: State, args: Args) -> Flag:
    """Whether the kinetic energy is a quadratic form of the velocities, by the law of
    parallelograms `T(a + b) + T(a - b) = 2 T(a) + 2 T(b)`, up to half of the digits."""
    assert isinstance(system, System | LagrangianSystem)
    if not callable(system.kinetic):
        return jnp.array(True)
    q, v = state.q, state.v
    size, number = 1 + jnp.max(jnp.abs(v)), jnp.arange(1, v.size + 1, dtype=v.dtype)
    a, b = size * jnp.cos(number), size * jnp.sin(2 * number)
    moved = 1e-2 * (1 + jnp.max(jnp.abs(q))) * direction_without_symmetry(q)
    # Another term can vanish at the start. Elsewhere the energy may not be defined.
    places = jnp.stack([q, q + moved]) if isinstance(system, LagrangianSystem) else q[None]
    energy = lambda q, v: system.kinetic_energy(State(q, v), args)
    probes = jnp.stack([a + b, a - b, a, b])
    found = jax.vmap(lambda q: jax.vmap(lambda v: energy(q, v))(probes))(places)
    signs = jnp.array([1, 1, -2, -2], found.dtype)
    error, most = jnp.abs(found @ signs), jnp.abs(found) @ jnp.abs(signs)
    off = error > jnp.sqrt(jnp.finfo(found.dtype).eps) * most
    return ~jnp.any(off & jnp.isfinite(error))


def _is_quadratic(
    system: AbstractSystem, state: State, inertia: Symmetric, args: Args
) -> Array:
    """Whether the kinetic energy is `1/2 v . inertia v`; a Hamiltonian need not be."""
    if isinstance(system, HamiltonianSystem):
        return jnp.array(True)
    error, bound = _quadratic_error(system, state, inertia, args)
    if isinstance(system, System):
        return error <= bound
    # Another term can vanish at the start. Elsewhere the energy may not be defined.
    q = state.q
    moved = 1e-2 * (1 + jnp.max(jnp.abs(q))) * direction_without_symmetry(q)
    nearby = State(q + moved, state.v)
    other, most = _quadratic_error(system, nearby, system.inertia(nearby, args), args)
    return (error <= bound) & ~((other > most) & jnp.isfinite(other))


def _quadratic_error(
    system: AbstractSystem, state: State, inertia: Symmetric, args: Args
) -> tuple[Array, Array]:
    """The difference of a kinetic energy from `1/2 v . inertia v`, and its round-off."""
    v = state.v
    energy = lambda v: system.kinetic_energy(State(state.q, v), args)
    # The probe has no symmetry, and is as large as the velocities.
    probe = (1 + jnp.max(jnp.abs(v))) * jnp.cos(jnp.arange(1, v.size + 1, dtype=v.dtype))
    quadratic = 0.5 * probe @ inertia @ probe
    error = jnp.abs(energy(probe) - quadratic) + jnp.abs(energy(-probe) - quadratic)
    size = jnp.abs(probe) @ jax.tree.map(jnp.abs, inertia) @ jnp.abs(probe)
    return error, 1e3 * jnp.finfo(v.dtype).eps * size


def _is_rigid(
    system: AbstractSystem, state: State, inertia: Symmetric, args: Args
) -> Array:
    """Whether the kinetic energy is one of the coordinates' kind."""
    if not isinstance(system, System):
        return jnp.array(True)
    energy = lambda v: system.kinetic_energy(State(state.q, v), args)
    return system.kinematics.has_inertia(energy, inertia)


def closes_over_traced_values(system: AbstractSystem, state: State, args: Args) -> bool:
    """Whether a function of the system has a value in its closure that is not known now.

    What follows from the values of all functions is then traced too.
    """
    return not is_known(values_of(_facts(system, state, args)))


def check_without_rotations(
    system: AbstractSystem, state: State, args: Args, scheme: str
) -> None:
    """Raises an error for a flat body in a scheme that moves no bodies by rotations."""
    if not isinstance(system, System):
        return
    if system.kinematics.with_rotations(state.q, (3,)) is system.kinematics:
        return
    facts = _facts(system, state, args)
    if is_known(facts) and not facts[_CONDITIONS.index("regular")]:
        raise ValueError(
            f"`{scheme}` takes the axes of rigid bodies as coordinates, and a body of this "
            "system is flat: it has no inertia along one of its axes. Give it a thickness, "
            "or use a scheme that moves bodies by rotations: `EnergyPreserving`, "
            "`EnergyDecaying`, `EnergyMomentumDecaying`, or `Composed` of the first."
        )


def check_values(system: AbstractSystem, state: State, args: Args) -> bool:
    """Raises an error for the first condition that the values of a system violate.

    Returns whether they are known: the functions of the system may close over tracers.
    """
    facts = _facts(system, state, args)
    if not is_known(facts):
        return False
    # The messages contain all numbers as text, which takes longer than a short run.
    violated = [
        name for name, ok in zip(_CONDITIONS, np.asarray(facts), strict=True) if not ok
    ]
    # A flat body is refused by `check_without_rotations` alone.
    if set(violated) <= {"regular"}:
        return True
    functions = {role: describe(role, fn) for role, fn, _ in energies(system, state, args)}
    kinetic = functions.get("kinetic", functions.get("hamiltonian"))
    potential = functions.get("potential", kinetic)
    messages = _messages_of_start(potential, state, args) | _messages_of_inertia(
        system, kinetic
    )
    for name in violated:
        if name in messages:
            raise ValueError(messages[name])
    return True


def _not_finite(args: Any, name: str) -> list[str]:
    """The numbers of `args` that are not finite, as `name = value`."""
    if callable(getattr(args, "keys", None)):
        found = [_not_finite(args[key], f"{name}[{key!r}]") for key in args.keys()]
        return [text for texts in found for text in texts]
    leaves = jax.tree_util.tree_leaves_with_path(args)
    return [
        f"`{name}{jax.tree_util.keystr(path)}` = {x}"
        for path, x in leaves
        if eqx.is_inexact_array(x) and not np.all(np.isfinite(x))
    ]


def _messages_of_start(potential: str | None, state: State, args: Args) -> dict[str, str]:
    """The messages about the start, forces, potential and constraints."""
    return {
        "start": f"The start is not finite: q = {state.q}, v = {state.v}.",
        "args": (
            "`args` holds a number that is not finite: "
            f"{', '.join(_not_finite(args, 'args'))}."
        ),
        "potential": (
            f"{potential} is not finite at the start, q = {state.q}. Is it defined there?"
        ),
        "timed": (
            f"`force` or `driven` is not finite at the start, t = {state.t}. Is it defined "
            "there?"
        ),
        "slope": (
            f"The slope of {potential} is not finite at the start, q = {state.q}. It must "
            "be differentiable there: the norm of a zero vector is not, nor the root of "
            "zero."
        ),
        "constraint": "The constraints are not finite at the start. Defined there?",
        "slopes": (
            f"The slope of a constraint is not finite at the start, q = {state.q}. Write "
            "lengths as squares: `d @ d - l**2`."
        ),
        "nonholonomic": (
            f"The matrix of `nonholonomic` is not finite at the start, q = {state.q}. Is "
            "it defined there?"
        ),
        "acts": (
            "A row of the matrix of `nonholonomic` is zero at the start, so it constrains "
            f"nothing there, q = {state.q}. Is it the derivative of a square?"
        ),
        "depends": (
            "A row of the constraints does not depend on `q` at the start: is it constant, "
            "or a square that vanishes there?"
        ),
    }


def _messages_of_inertia(system: AbstractSystem, kinetic: str | None) -> dict[str, str]:
    """The messages about the inertia."""
    inertia, missing = "inertia matrix", "A coordinate without mass, or a negative mass?"
    not_smooth = (
        " A kinetic energy must have second derivatives at `v = 0`: write `v @ v`, not the "
        "square of a norm."
    )
    if isinstance(system, HamiltonianSystem):
        inertia = f"inverse Hessian of {kinetic} in the momenta"
        missing = "Is a momentum without energy, or at a singular configuration?"
        not_smooth = f" {missing}"
    elif kinetic is not None:
        inertia = f"inertia (the Hessian of {kinetic})"
    if isinstance(system, LagrangianSystem):
        missing += " Or are the coordinates singular at the start (polar ones at r = 0)?"
    varies = " Inertia that varies: `System.from_lagrangian`."
    if not isinstance(system, System):
        varies = ""
    return {
        "inertia": f"The {inertia} is not finite.{not_smooth}",
        "quadratic": (
            f"{kinetic} is not quadratic in the velocities: it must be `1/2 v . M v`, with "
            f"no linear or constant part.{varies} Other energies: "
            "`System.from_hamiltonian`."
        ),
        "symmetric": f"The {inertia} is not symmetric.",
        "definite": (
            f"The {inertia} is not positive definite. {missing} Every velocity needs some "
            "inertia."
        ),
        "rigid": (
            f"The {inertia} is not that of rigid bodies: with the same velocities in body "
            "axes the kinetic energy changes from one rotation to another. That of each "
            "body in `rigid_bodies` must be `m |xdot|^2/2 + "
            "sum_ij E_ij d_i_dot . d_j_dot/2` with its mass centre `x` and axes `d_i`, in "
            "the plane `m |xdot|^2/2 + J angle_rate^2/2`. Is "
            "`x` another point of the body, or does a term couple bodies? Take the mass "
            "centre; a point with the components `p_i` in body axes is `x + "
            "sum_i p_i d_i`. Or leave out `rigid_bodies` and write the "
            "constraints between the axes in `constraint`."
        ),
    }
