"""Malformed inputs: what is given, the error, and a part of its message."""

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
    save_every=1,
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
        save_every=save_every,
        t0=t0,
    )


# What is given, the error, and a part of its message.
BAD = {
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
    "q not finite": (dict(q=(np.nan, 0.0)), ValueError, "start is not finite"),
    "v not finite": (dict(v=(np.inf, 0.0)), ValueError, "start is not finite"),
    "q complex": (dict(q=(1j, 0.0)), (TypeError, ValueError), "real"),
    "q a scalar": (dict(q=1.0), ValueError, "vector"),
    "q a batch": (dict(q=((1.0, 0.0),)), ValueError, "vmap"),
    "q empty": (dict(q=(), v=()), ValueError, "at least one"),
    "q and v of different dtypes": (
        dict(q=np.array([1.0, 0.0], np.float32)),
        TypeError,
        "one dtype",
    ),
    "q and v of different sizes": (dict(v=(0.0, 0.0, 0.0)), ValueError, "kinematics"),
    "start a tuple": (dict(start=((1.0, 0.0), (0.0, 0.0))), TypeError, "State"),
    "potential undefined at the start": (
        dict(potential=lambda q, args: jnp.log(-q[0])),
        ValueError,
        "not finite at the start",
    ),
    "h zero": (dict(h=0.0), ValueError, "positive"),
    "h negative": (dict(h=-0.01), ValueError, "positive"),
    "h not finite": (dict(h=np.nan), ValueError, "positive"),
    "h infinite": (dict(h=np.inf), ValueError, "finite"),
    "h an array": (dict(h=np.array([0.01, 0.02])), ValueError, "vmap"),
    "num_steps not whole": (dict(num_steps=4.0), ValueError, "num_steps"),
    "num_steps zero": (dict(num_steps=0), ValueError, "num_steps"),
    "save_every zero": (dict(save_every=0), ValueError, "save_every"),
    "num_steps not a multiple": (dict(save_every=3), ValueError, "multiple"),
    "scheme a class": (dict(scheme=ej.EnergyPreserving), TypeError, "parentheses"),
    "scheme a name": (dict(scheme="ggl"), TypeError, "scheme"),
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
    "time not finite": (dict(t0=np.inf), ValueError, "time of the start"),
    "consistent scheme with kinematics": (
        dict(kinematics=turn, scheme=ej.EnergyConsistent(0.5)),
        ValueError,
        "kinematics",
    ),
    "args without a key": (
        dict(args=dict(m=1.0, l=1.0)),
        ValueError,
        "`potential` raised KeyError: 'g'.*the keys \\['l', 'm'\\]",
    ),
    "args forgotten": (dict(args=None), ValueError, "`args` is None here"),
    "args a list": (dict(args=[1.0, 1.0, 9.81]), ValueError, "of type list"),
    "args a string": (dict(args=ARGS | dict(g="9.81")), ValueError, "`potential` raised"),
    "args complex": (
        dict(args=ARGS | dict(g=9.81 + 1j)),
        (TypeError, ValueError),
        "`potential`",
    ),
    "args not finite": (dict(args=ARGS | dict(g=np.inf)), ValueError, "`args` holds"),
    "args in single precision": (
        dict(args=ARGS | dict(g=np.array(9.81, np.float32))),
        TypeError,
        "`args\\['g'\\]` is float32 and the start is float64",
    ),
    "start in single precision": (
        dict(
            q=np.array([1, 0], np.float32),
            v=np.zeros(2, np.float32),
            args=ARGS | dict(g=np.array(9.81)),
        ),
        TypeError,
        "`args\\['g'\\]` is float64 and the start is float32",
    ),
    "args a mass for each body": (
        dict(args=ARGS | dict(m=np.array([1.0, 2.0]))),
        ValueError,
        "must return a scalar, an energy, got shape \\(2,\\)",
    ),
    "q in half precision": (
        dict(q=np.array([1, 0], np.float16), v=np.zeros(2, np.float16)),
        TypeError,
        "float16: give them as float64 or float32",
    ),
    "h a string": (dict(h="0.01"), TypeError, "`h` must be a real number"),
    "h forgotten": (dict(h=None), TypeError, "`h` must be a real number"),
    "h complex": (dict(h=0.01 + 1j), TypeError, "`h` must be a real number"),
    "time a string": (dict(t0="now"), TypeError, "must be a real number"),
    "time a vector": (dict(t0=np.zeros(2)), ValueError, "time of the start"),
    "num_steps negative": (dict(num_steps=-4), ValueError, "num_steps"),
    "num_steps a string": (dict(num_steps="4"), ValueError, "num_steps"),
    "num_steps a flag": (dict(num_steps=True), ValueError, "num_steps"),
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
    "start off the constraints": (
        dict(q=(2.0, 0.0)),
        RuntimeError,
        "does not satisfy the constraints",
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


# What a type checker refuses first, where the tests run under one.
WRONG_TYPES = (
    "start a tuple",
    "h an array",
    "num_steps not whole",
    "scheme a class",
    "scheme a name",
    "potential not a function",
    "constraint not a function",
    "q in half precision",
    "h a string",
    "h forgotten",
    "time a string",
    "time a vector",
    "num_steps a string",
    "kinetic forgotten",
    "kinetic a string",
    "force not a function",
    "driven not a function",
)
