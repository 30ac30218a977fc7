"""A system, and malformed functions for it with the error and a part of its message."""

import math

import jax.numpy as jnp
import numpy as np

import enerjax as ej


ARGS = dict(m=1.0, l=1.0, g=9.81)


def kinetic(v, args):
    return 0.5 * args["m"] * v @ v


def potential(q, args):
    return -args["m"] * args["g"] * q[1]


def rod(q, args):
    return jnp.array([q @ q - args["l"] ** 2])


def turn(q, args):
    """Velocities of a point in axes that turn with it: `nv = nq = 2`."""
    return jnp.array([[q[1], -q[0]], [q[0], q[1]]])


def simulate(
    kinetic=kinetic,
    potential=potential,
    constraint=rod,
    *,
    scheme=None,
    q=(1.0, 0.0),
    v=(0.0, 0.0),
    start=None,
    args=ARGS,
    h=0.01,
    num_steps=4,
    every=1,
    t0=0.0,
    **system,
):
    return ej.simulate(
        ej.System(kinetic, potential, constraint, **system),
        ej.EnergyPreserving() if scheme is None else scheme,
        ej.State(jnp.asarray(q), jnp.asarray(v)) if start is None else start,
        args,
        h=h,
        num_steps=num_steps,
        saveat=ej.SaveAt(every=every),
        t0=t0,
    )


BAD_FUNCTIONS = {
    "constraint a scalar": (
        dict(constraint=lambda q, args: q @ q - 1),
        ValueError,
        "must return a vector",
    ),
    "constraint a list": (dict(constraint=lambda q, args: [q @ q - 1]), TypeError, "array"),
    "potential a vector": (dict(potential=lambda q, args: q), ValueError, "scalar"),
    "kinetic a vector": (dict(kinetic=lambda v, args: v), ValueError, "scalar"),
    "potential not a function": (dict(potential=1.0), TypeError, "potential"),
    "constraint not a function": (dict(constraint=np.ones(1)), TypeError, "constraint"),
    "inertia of the wrong shape": (dict(kinetic=np.eye(3)), ValueError, "inertia"),
    "inertia a vector": (dict(kinetic=np.ones(2)), ValueError, "inertia"),
    "inertia not symmetric": (
        dict(kinetic=np.array([[1.0, 0.5], [0.0, 1.0]])),
        ValueError,
        "not symmetric",
    ),
    "inertia indefinite": (
        dict(kinetic=np.array([[1.0, 2.0], [2.0, 1.0]])),
        ValueError,
        "positive definite",
    ),
    "inertia negative": (dict(args=ARGS | dict(m=-1.0)), ValueError, "Hessian"),
    "inertia zero": (dict(args=ARGS | dict(m=0.0)), ValueError, "not finite|definite"),
    "inertia not finite": (dict(args=ARGS | dict(m=np.nan)), ValueError, "finite"),
    "kinetic of fourth degree": (
        dict(kinetic=lambda v, args: 0.5 * v @ v + 0.1 * (v @ v) ** 2),
        ValueError,
        "not quadratic",
    ),
    "kinetic with a linear part": (
        dict(kinetic=lambda v, args: 0.5 * v @ v + v[0]),
        ValueError,
        "not quadratic",
    ),
    "kinetic with a constant": (
        dict(kinetic=lambda v, args: 0.5 * v @ v + 1.0),
        ValueError,
        "not quadratic",
    ),
    "potential undefined at the start": (
        dict(potential=lambda q, args: jnp.log(-q[0])),
        ValueError,
        "not finite at the start",
    ),
    "coordinate constraint without kinematics": (
        dict(coordinate_constraint=rod),
        ValueError,
        "without `kinematics`",
    ),
    "too many coordinate constraints": (
        dict(kinematics=turn, coordinate_constraint=rod),
        ValueError,
        "redundant 0 times",
    ),
    "kinematics of the wrong shape": (
        dict(kinematics=lambda q, args: jnp.eye(3)),
        ValueError,
        "needs \\(2, 2\\)",
    ),
    "too few coordinate constraints": (
        dict(kinematics=lambda q, args: jnp.eye(2)[:1], v=(0.0,)),
        ValueError,
        "redundant 1 times",
    ),
    "force of the wrong shape": (
        dict(force=lambda q, v, t, args: v[:1]),
        ValueError,
        "`force` returned shape \\(1,\\)",
    ),
    "force without time": (
        dict(force=lambda q, v, args: v),
        TypeError,
        "must take 4 arguments, `\\(q, v, t, args\\)`",
    ),
    "force not finite": (
        dict(force=lambda q, v, t, args: v / t),
        ValueError,
        "not finite at the start",
    ),
    "force with backward stages": (
        dict(force=lambda q, v, t, args: -v, scheme=ej.Composed(ej.EnergyPreserving(), 4)),
        ValueError,
        "go backwards in time",
    ),
    "driven a scalar": (dict(driven=lambda q, t, args: q[0]), ValueError, "a vector"),
    "driven without time": (
        dict(driven=lambda q, args: q),
        TypeError,
        "must take 3 arguments, `\\(q, t, args\\)`",
    ),
    "potential with math": (
        dict(potential=lambda q, args: math.cos(q[0])),
        TypeError,
        "not `math` or `numpy`",
    ),
    "potential with numpy": (
        dict(potential=lambda q, args: np.cos(q[0])),
        TypeError,
        "not `math` or `numpy`",
    ),
    "potential with if": (
        dict(potential=lambda q, args: q[0] if q[0] > 0 else q[1]),
        TypeError,
        "`jnp.where` instead of `if`",
    ),
    "potential an integer": (
        dict(potential=lambda q, args: jnp.sum(q).astype(int)),
        TypeError,
        "got int64",
    ),
    "potential without return": (
        dict(potential=lambda q, args: None),
        TypeError,
        "a Python NoneType",
    ),
    "potential with a kink at the start": (
        dict(potential=lambda q, args: jnp.sqrt(q[1] ** 2)),
        ValueError,
        "The slope of `potential` is not finite",
    ),
    "kinetic forgotten": (dict(kinetic=None), TypeError, "`kinetic` must be a function"),
    "kinetic a string": (dict(kinetic="v**2"), TypeError, "`kinetic` must be a function"),
    "kinetic the square of a norm": (
        dict(kinetic=lambda v, args: 0.5 * jnp.linalg.norm(v) ** 2),
        ValueError,
        "write `v @ v`",
    ),
    "inertia complex": (dict(kinetic=1j * np.eye(2)), TypeError, "the real inertia"),
    "constraint constant": (
        dict(constraint=lambda q, args: args["l"][None] - 1.0),
        ValueError,
        "does not depend on `q`",
    ),
    "constraint squared": (
        dict(constraint=lambda q, args: rod(q, args) ** 2),
        ValueError,
        "does not depend on `q`",
    ),
    "constraints that contradict each other": (
        dict(constraint=lambda q, args: jnp.array([q @ q - 1.0, q @ q - 4.0])),
        RuntimeError,
        "does not satisfy the constraints",
    ),
    "constraints that repeat each other": (
        dict(constraint=lambda q, args: jnp.array([q @ q - 1.0, q @ q - 1.0])),
        RuntimeError,
        "redundant",
    ),
    "more constraints than coordinates": (
        dict(constraint=lambda q, args: jnp.array([q[0] - 1.0, q[1], q @ q - 1.0])),
        ValueError,
        "3 constraints of 2 coordinates",
    ),
    "constraint a matrix": (
        dict(constraint=lambda q, args: q[None]),
        ValueError,
        "must return a vector, got shape \\(1, 2\\)",
    ),
    "constraint undefined at the start": (
        dict(constraint=lambda q, args: jnp.sqrt(-q[:1])),
        ValueError,
        "constraints are not finite",
    ),
    "constraint a distance that vanishes": (
        dict(constraint=lambda q, args: jnp.linalg.norm(q - jnp.eye(2)[0])[None]),
        ValueError,
        "Write lengths as squares",
    ),
    "constraint without args": (
        dict(constraint=lambda q: q[:1]),
        TypeError,
        "must take 2 arguments",
    ),
    "force a list": (
        dict(force=lambda q, v, t, args: [0.0, 0.0]),
        TypeError,
        "a Python list",
    ),
    "force not a function": (dict(force=np.ones(2)), TypeError, "`force` must be"),
    "driven not finite": (
        dict(driven=lambda q, t, args: jnp.sqrt(t - 1.0) * q[:1]),
        ValueError,
        "not finite at the start",
    ),
    "driven not a function": (dict(driven=1.0), TypeError, "`driven` must be"),
}
