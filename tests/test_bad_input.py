"""Bad input: one clear error before any step, wherever it can be known then."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


def test_the_input_that_the_others_spoil_is_good():
    assert simulate().stats.completed_steps == 4


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
)


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_clear_error(case, is_type_checked):
    if is_type_checked and case in WRONG_TYPES:
        pytest.skip("the type checker refuses it first")
    given, error, message = BAD[case]
    with pytest.raises(error, match=message) as caught:
        simulate(**given)
    # An error of this package, not one that escaped from a library below.
    assert "enerjax" in str(caught.traceback[-1].path)


def test_bad_shapes_are_told_under_jit_too():
    with pytest.raises(ValueError, match="must return a vector"):
        jax.jit(lambda h: simulate(constraint=lambda q, args: q @ q - 1, h=h))(0.01)


def test_the_step_checks_its_input_too():
    system = ej.System(kinetic, potential, rod)
    with pytest.raises(ValueError, match="positive"):
        ej.step(system, ej.EnergyPreserving(), ej.State([1.0, 0.0], [0.0, 0.0]), ARGS, h=-1)


SINGLE = """
import warnings
import enerjax as ej
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    system, start, args = ej.problems.pendulum()
    runs = [
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=50)
        for h in (0.01, 0.02)
    ]
ours = [str(w.message) for w in caught if "float32" in str(w.message)]
assert len(ours) == 1, ours
assert "jax_enable_x64" in ours[0]
assert runs[1].ys.q.dtype == "float32"
# Single precision: 1e-7 of the turnover a step.
assert abs(runs[1].audit.energy).max() < 1e-4
assert abs(runs[1].audit.constraint).max() < 1e-5
"""


def test_single_precision_is_warned_of_once_and_works():
    done = subprocess.run([sys.executable, "-c", SINGLE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
