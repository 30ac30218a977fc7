"""Problems, schemes, runs and references that the tests share.

Compilation dominates: runs are cached, those that differ in numbers alone share a program,
and `march` has one program for all numbers of steps.
"""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import enerjax as ej


EPS = float(np.finfo(float).eps)

PROBLEMS = {
    "angle": ej.problems.pendulum_angle,
    "pendulum": ej.problems.pendulum,
    "double": ej.problems.double_pendulum,
    "stiff": ej.problems.stiff_double_pendulum,
    "spring": ej.problems.spring_pendulum,
    "chain": lambda: ej.problems.chain(4),
    "top": ej.problems.heavy_top,
    "body": ej.problems.free_rigid_body,
    "particles": ej.problems.four_particles,
}

# sum m g r, the energy that a pendulum turns over: E0 is 0 in most of them.
TURNOVER = {
    "angle": 9.81,
    "pendulum": 9.81,
    "double": 9.81 * (1 + 2),
    "stiff": 9.81 * (0.005 + 2),
    "spring": 9.81,
    "top": 5436.0,
    "body": 2500.0,
    "particles": 1.1764705882352942,
}

SCHEMES = {
    "preserving": lambda alpha: ej.EnergyPreserving(),
    "preserving index3": lambda alpha: ej.EnergyPreserving("index3"),
    "preserving gauss": lambda alpha: ej.EnergyPreserving(derivative=ej.MeanValue()),
    "decaying": ej.EnergyDecaying,
    "decaying index3": lambda alpha: ej.EnergyDecaying(alpha, "index3"),
    "decaying gauss": lambda alpha: ej.EnergyDecaying(alpha, derivative=ej.MeanValue()),
    "kappa": ej.KappaDecaying,
    "consistent": ej.EnergyConsistent,
    "composed 4": lambda alpha: ej.Composed(ej.EnergyPreserving(), 4),
    "composed 6": lambda alpha: ej.Composed(ej.EnergyPreserving(), 6),
    "composed 8": lambda alpha: ej.Composed(ej.EnergyPreserving(), 8),
    "consistent 6": lambda alpha: ej.Composed(ej.EnergyConsistent(0.0), 6),
    "consistent 8": lambda alpha: ej.Composed(ej.EnergyConsistent(0.0), 8),
}


@functools.cache
def problem(name):
    return PROBLEMS[name]()


@functools.cache
def solve(name, scheme, alpha=0.0, *, h, steps, save_every=1):
    """A run with NumPy leaves; a failure is left in its `result`."""
    system, start, args = problem(name)
    solution = ej.simulate(
        system,
        SCHEMES[scheme](alpha),
        start,
        args,
        h=h,
        num_steps=steps,
        save_every=save_every,
        throw=False,
    )
    return jax.device_get(solution)


@eqx.filter_jit
def _march(system, scheme, start, args, h, steps):
    def body(_, carry):
        state, okay = carry
        out = ej.step(system, scheme, state, args, h=h)
        return out.state, okay & (out.result == ej.RESULTS.successful)

    return jax.lax.fori_loop(0, steps, body, (start, jnp.array(True)))


@functools.cache
def march(name, scheme, alpha=0.0, *, h, steps):
    """The state after some steps; the number of steps is traced."""
    system, start, args = problem(name)
    state, okay = _march(
        system, SCHEMES[scheme](alpha), start, args, jnp.asarray(h), jnp.asarray(steps)
    )
    assert okay, f"{scheme} with alpha = {alpha} on {name}, h = {h}: a step failed"
    return jax.device_get(state)


def failed(solution):
    return bool(solution.result != ej.RESULTS.successful)


def slopes(errors):
    """Orders between halvings of the step."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


# References in minimal coordinates, by an explicit method of order 8 -------------------


def _integrate(rates, start, t):
    return solve_ivp(rates, (0, t), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


@functools.cache
def pendulum_reference(t, g=9.81, l=1.0):
    """Angle from the vertical and its rate; released from the horizontal at rest."""
    return _integrate(lambda _, y: [y[1], -g / l * np.sin(y[0])], [np.pi / 2, 0.0], t)


@functools.cache
def double_pendulum_reference(t, m1=1.0, m2=1.0, g=9.81):
    """Points and velocities of two unit rods; angles from +x towards +y, gravity +y."""

    def rates(_, y):
        a, b, da, db = y
        coupling = m2 * np.cos(a - b)
        inertia = np.array([[m1 + m2, coupling], [coupling, m2]])
        swirl = m2 * np.sin(a - b)
        torque = [
            -swirl * db**2 + (m1 + m2) * g * np.cos(a),
            swirl * da**2 + m2 * g * np.cos(b),
        ]
        return [da, db, *np.linalg.solve(inertia, torque)]

    a, b, da, db = _integrate(rates, [0.0, np.pi / 2, 0.0, 0.0], t)
    inner, outer = np.array([np.cos(a), np.sin(a)]), np.array([np.cos(b), np.sin(b)])
    turn = np.array([[0, -1], [1, 0]])
    v_inner, v_outer = da * turn @ inner, db * turn @ outer
    return SimpleNamespace(
        q=np.concatenate([inner, inner + outer]),
        v=np.concatenate([v_inner, v_inner + v_outer]),
    )


@functools.cache
def spring_pendulum_reference(t, k=100.0, g=9.81):
    def rates(_, y):
        length = np.hypot(y[0], y[1])
        pull = -k * (length - 1) / length
        return [y[2], y[3], pull * y[0], pull * y[1] + g]

    y = _integrate(rates, [1.0, 0.0, 0.0, 0.0], t)
    return SimpleNamespace(q=y[:2], v=y[2:])


def point_on_rod(t):
    """Case b from the angle of case a: the same motion, with gravity along +y."""
    angle, rate = pendulum_reference(t)
    return SimpleNamespace(
        q=np.array([np.sin(angle), np.cos(angle)]),
        v=rate * np.array([np.cos(angle), -np.sin(angle)]),
    )
