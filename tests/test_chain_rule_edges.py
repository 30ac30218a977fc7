"""The chain rule where formulas divide by zero, saturate, switch or cross a cut."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


grad = ej.discrete_grad


@pytest.mark.parametrize("power", [1.5, 2.5, 2.2, 3.0])
@pytest.mark.slow_for("2.2")
def test_powers_from_zero_and_across_it(power):
    ramp = lambda x: jnp.maximum(x, 0.0) ** power
    assert grad(ramp)(-1.0, -0.5) == 0
    np.testing.assert_allclose(grad(ramp)(-1.0, 0.5), 0.5**power / 1.5, rtol=1e-14)
    np.testing.assert_allclose(grad(ramp)(0.0, 0.5), 0.5 ** (power - 1), rtol=1e-14)
    at_zero = lambda b: jnp.sum(grad(lambda q: (q @ q) ** power)(jnp.zeros(2), b))
    assert jnp.all(grad(lambda q: (q @ q) ** power)(jnp.zeros(2), jnp.zeros(2)) == 0)
    assert jnp.all(jnp.isfinite(jax.jacrev(jax.grad(at_zero))(jnp.zeros(2))))


def test_whole_powers_of_negative_numbers_need_not_be_known():
    quotient = jax.jit(lambda n, a, b: grad(lambda x: x**n)(a, b))
    assert quotient(2.0, -1.0, -0.5) == pytest.approx(-1.5, rel=1e-14)
    assert quotient(3.0, -1.0, 0.5) == pytest.approx(0.75, rel=1e-14)
    assert quotient(-1.0, -1.0, -0.5) == pytest.approx(-2.0, rel=1e-14)


@pytest.mark.parametrize("increment", [1e-3, 1e-6, 1e-9])
def test_guards_of_removable_singularities(increment):
    def guarded(q):
        safe = jnp.where(q == 0, 1.0, q)
        return jnp.where(q == 0, 1.0, jnp.sin(safe) / safe)

    # Round-off of the values, 1, over the increment.
    error = abs(float(grad(guarded)(0.0, increment)) + increment / 6)
    assert error <= 2e-16 / increment + increment**3 / 100


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_tails_keep_their_digits(dtype):
    eps = float(jnp.finfo(dtype).eps)
    at = lambda x: jnp.asarray(x, dtype)
    deep = 40 if dtype == jnp.float64 else 15
    log_sigmoid = lambda x: jnp.log(jax.nn.sigmoid(x))
    slope = grad(log_sigmoid)(at(-deep - 0.25), at(-deep))
    assert float(slope) == pytest.approx(1, abs=2 * np.exp(-deep) + 50 * eps)
    tail = (jax.nn.sigmoid(at(-30.5)) - jax.nn.sigmoid(at(-30.0))) / -0.5
    assert float(grad(jax.nn.sigmoid)(at(-30.0), at(-30.5))) == pytest.approx(
        float(tail), rel=50 * eps
    )
    assert float(grad(jnp.tanh)(at(-400.0), at(400.0))) == pytest.approx(1 / 400)
    erfc = jax.scipy.special.erfc
    a, b = at(5.0), at(5.7)
    exact = (erfc(b) - erfc(a)) / (b - a)
    assert float(grad(erfc)(a, b)) == pytest.approx(float(exact), rel=100 * eps)


A, B = jnp.array([-1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 2.0])


def iterated(q):
    """Loops have no rule for a choice that was made before them."""
    choice = q[0] > 0
    turn = lambda x, _: (jnp.where(choice, jnp.sin(x), x * x), None)
    return jax.lax.scan(turn, q[1], None, length=2)[0]


CHOICES = {
    "cond": lambda q: jax.lax.cond(q[0] > 0, lambda q: jnp.sum(q**4), lambda q: q @ q, q),
    "where": lambda q: jnp.where(q[0] > 0, jnp.sum(q**4), q @ q),
    "index": lambda q: q[jnp.argmin(q)] * q[0],
    "floor": lambda q: jnp.floor(2 * q[0]) * q[1],
    "loop": iterated,
}


@pytest.mark.parametrize("name", CHOICES)
def test_choices_that_change_are_symmetric_and_exact(name):
    function = CHOICES[name]
    forward, backward = grad(function)(A, B), grad(function)(B, A)
    np.testing.assert_allclose(forward, backward, rtol=1e-13, atol=1e-13)
    change = function(B) - function(A)
    np.testing.assert_allclose(forward @ (B - A), change, rtol=1e-13, atol=1e-13)


def test_a_cond_that_does_not_change_is_exact():
    """A pair potential with a cut-off: no force and no torque of its own."""

    def pair(q):
        square = jnp.sum((q[:3] - q[3:]) ** 2)
        near = lambda s: s**-6 - s**-3
        return jax.lax.cond(square < 9, near, lambda s: 0 * s, square)

    a = jnp.array([0.0, 0.1, 0.2, 1.0, 0.4, -0.3])
    b = a + jnp.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.4])
    assert ej.discrete_fallbacks(pair)(a, b) == []
    force = grad(pair)(a, b)
    np.testing.assert_allclose(force[:3] + force[3:], 0, atol=1e-14)
    middle = 0.5 * (a + b)
    torque = jnp.cross(middle[:3], force[:3]) + jnp.cross(middle[3:], force[3:])
    np.testing.assert_allclose(torque, 0, atol=1e-14)


def test_an_angle_straight_across_the_origin():
    angle = lambda q: jnp.arctan2(q[1], q[0])
    a, b = jnp.array([1.0, 0.0]), jnp.array([-1.0, 0.0])
    np.testing.assert_allclose(grad(angle)(a, b) @ (b - a), jnp.pi, rtol=1e-15)


def test_complex_numbers_inside():
    modulus = lambda q: jnp.abs(jax.lax.complex(q[0], q[1])) ** 2
    a, b = jnp.array([1.0, 2.0]), jnp.array([2.0, 3.0])
    np.testing.assert_allclose(grad(modulus)(a, b), a + b, rtol=1e-14)
    spectrum = lambda q: jnp.sum(jnp.fft.irfft(jnp.fft.rfft(q)))
    with pytest.raises(TypeError, match="complex"):
        grad(spectrum)(jnp.arange(4.0), jnp.ones(4))
    with pytest.raises(TypeError, match="real arrays"):
        ej.discrete_jacobian(lambda q: q > 0)(a, b)


def test_a_stiff_contact_runs():
    """A Hertzian floor, which exerts no force on what is above it, as in the first step."""
    floor = lambda q, args: 9.81 * q[0] + 1e4 * jnp.maximum(-q[0], 0.0) ** 2.5
    system = ej.System(jnp.eye(1), floor)
    start = ej.initial_state(system, [0.1], [0.0])
    run = ej.simulate(system, ej.EnergyPreserving(), start, h=1e-3, num_steps=400)
    assert float(jnp.min(run.ys.q)) < -0.01
    energy = run.audit.energy
    assert float(jnp.max(jnp.abs(energy - energy[0]))) <= 1e-12
