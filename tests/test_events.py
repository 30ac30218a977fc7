"""Events that end steps exactly, and impacts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


# A ball that falls from a height on a floor ----------------------------------------------

BALL = ej.System(jnp.eye(1), lambda q, args: args["g"] * q[0])
# Of a ball from height 1 with g = 9.81 and restitution 0.9: the bounces, in closed form.
FIRST = np.sqrt(2 / 9.81)
BOUNCES = FIRST * (2 * np.cumsum(0.9 ** np.arange(8)) - 1)


def height(q, args):
    return q[0]


def falling(numbers, t1=4.5, events: Any = None, **options: Any) -> Any:
    """A run of the ball from numbers (height, restitution, g, step)."""
    h0, e, g, h = numbers
    start = ej.State(jnp.stack([h0]), jnp.zeros(1))
    return ej.simulate(
        BALL,
        ej.EnergyPreserving(),
        start,
        dict(g=g),
        h=h,
        t1=t1,
        events=ej.Impact(height, e) if events is None else events,
        **{"max_events": 20, "max_steps": 450, **options},
    )


@pytest.fixture(scope="module")
def bouncing():
    run = jax.jit(lambda x: falling(x, saveat=ej.SaveAt(every=1)))
    return jax.device_get(run(jnp.array([1.0, 0.9, 9.81, 0.01])))


def test_times_of_bounces_are_exact(bouncing):
    # Midpoint steps are exact in a constant field, so the error is round-off alone.
    assert bouncing.events.count == 7
    np.testing.assert_allclose(bouncing.events.ts[:7], BOUNCES[:7], rtol=2e-14)
    assert np.all(np.isnan(bouncing.events.ts[7:]))


def test_the_state_on_both_sides_of_a_bounce(bouncing):
    events, speed = bouncing.events, np.sqrt(2 * 9.81) * 0.9 ** np.arange(7)
    # Round-off.
    np.testing.assert_allclose(events.before.v[:7, 0], -speed, rtol=1e-13)
    np.testing.assert_allclose(events.after.v[:7, 0], 0.9 * speed, rtol=1e-13)
    assert np.abs(events.after.q[:7]).max() < 1e-14
    assert events.happened[:, 0].sum() == 7


def test_rows_between_bounces_are_those_of_the_parabolas(bouncing):
    times = bouncing.ts
    last = np.searchsorted(BOUNCES, times, side="right") - 1
    since = times - np.where(last < 0, -FIRST, BOUNCES[np.maximum(last, 0)])
    speed = np.sqrt(2 * 9.81) * 0.9 ** (last + 1)
    exact = speed * since - 0.5 * 9.81 * since**2
    np.testing.assert_allclose(times, 0.01 * np.arange(451), atol=1e-14)
    # Round-off, which grows with the number of bounces.
    np.testing.assert_allclose(bouncing.ys.q[:, 0], exact, atol=1e-13)


def test_the_audit_counts_the_loss_of_impacts(bouncing):
    lost = 0.5 * (1 - 0.9**2) * 2 * 9.81 * 0.9 ** (2 * np.arange(7))
    audit = bouncing.audit
    np.testing.assert_allclose(audit.impact.sum(), lost.sum(), rtol=1e-13)
    assert np.abs(audit.leak).max() < 2e-14 * 9.81  # round-off
    assert np.count_nonzero(audit.impact) == 7


def test_derivatives_through_a_bounce_are_those_of_the_closed_form():
    t1 = 0.8

    def exact(numbers):
        h0, e, g, _ = numbers
        first = jnp.sqrt(2 * h0 / g)
        return e * g * first * (t1 - first) - 0.5 * g * (t1 - first) ** 2

    end = lambda x: falling(x, t1, max_steps=90).ys.q[-1, 0]
    numbers = jnp.array([1.0, 0.9, 9.81, 0.01])
    value, slope = jax.jit(jax.value_and_grad(end))(numbers)
    np.testing.assert_allclose(value, exact(numbers), rtol=1e-13)
    # Round-off. The step has no influence, so its derivative is zero.
    np.testing.assert_allclose(slope, jax.grad(exact)(numbers), atol=1e-12)
    _, forward = jax.jit(lambda x: jax.jvp(end, (x,), (jnp.ones_like(x),)))(numbers)
    np.testing.assert_allclose(forward, jnp.sum(slope), atol=1e-12)


def test_lanes_have_events_of_their_own():
    heights = jnp.array([0.3, 1.0, 50.0, 0.7])
    numbers = lambda h0: jnp.stack([h0, *jnp.array([0.9, 9.81, 0.01])])
    run = lambda h0: falling(numbers(h0), 1.0, max_steps=100)
    batch = jax.jit(jax.vmap(run))(heights)
    single = jax.jit(run)
    for k, h0 in enumerate(heights):
        alone = single(h0)
        assert int(batch.events.count[k]) == int(alone.events.count)
        # Round-off: the operations of a batch are merged in another way.
        np.testing.assert_allclose(batch.ys.q[k], alone.ys.q, atol=1e-13)
        np.testing.assert_allclose(batch.events.ts[k], alone.events.ts, atol=1e-13)
    assert list(np.asarray(batch.events.count)) == [2, 1, 0, 1]


# A rigid pendulum that hits a stop -------------------------------------------------------

# A point on a rod of length 1 that hits a wall at x = 0.5.
PENDULUM = ej.System(
    jnp.eye(2),
    lambda q, args: 9.81 * q[1],
    constraint=lambda q, args: jnp.stack([0.5 * (q @ q - 1)]),
)
WALL = 0.5


def to_wall(q, args):
    return WALL - q[0]


def swinging(h, e, num_steps, scheme=None, **options: Any) -> Any:
    start = ej.initial_state(PENDULUM, [-0.6, -0.8], [0.0, 0.0])
    return ej.simulate(
        PENDULUM,
        ej.EnergyPreserving() if scheme is None else scheme,
        start,
        h=h,
        num_steps=num_steps,
        events=ej.Impact(to_wall, e),
        **options,
    )


@pytest.fixture(scope="module")
def elastic():
    return swinging(0.01, 1.0, 2000, max_events=40)


def test_elastic_hits_keep_energy_and_constraints(elastic):
    audit = elastic.audit
    assert int(elastic.events.count) == 12
    # Round-off of all steps, against a kinetic energy of 2.
    assert np.abs(audit.energy - audit.energy[0]).max() < 1e-12
    assert np.abs(audit.impact).max() < 1e-13
    assert np.abs(audit.constraint).max() < 1e-14
    assert np.abs(audit.constraint_rate).max() < 1e-13
    # No row is beyond the wall, by more than round-off.
    assert np.asarray(to_wall(elastic.ys.q.T, None)).min() > -1e-14


def test_a_hit_reverses_the_rate_of_the_gap(elastic):
    count = int(elastic.events.count)
    before, after = (
        np.asarray(x.v[:count, 0]) for x in (elastic.events.before, elastic.events.after)
    )
    np.testing.assert_allclose(after, -before, rtol=1e-12)  # round-off
    np.testing.assert_allclose(elastic.events.before.q[:count, 0], WALL, atol=1e-14)


def test_the_loss_of_a_hit_is_that_in_minimal_coordinates():
    sol = swinging(0.01, 0.5, 150, max_events=4)
    before, after = sol.events.before, sol.events.after
    # In the angle the mass is 1 and the rate of the gap is proportional to the speed.
    speed = np.linalg.norm(before.v[0])
    np.testing.assert_allclose(np.linalg.norm(after.v[0]), 0.5 * speed, rtol=1e-13)
    lost = 0.5 * speed**2 * (1 - 0.25)
    np.testing.assert_allclose(np.asarray(sol.audit.impact).max(), lost, rtol=1e-12)


@pytest.mark.parametrize(
    ("scheme", "order"),
    [(ej.EnergyPreserving(), 2), (ej.Composed(ej.EnergyPreserving(), 4), 4)],
)
def test_times_of_events_have_the_order_of_the_scheme(scheme, order):
    # The first hit, from the angle by quadrature: energy conservation gives the speed.
    from scipy.integrate import quad

    # With y = -cos(x): the substitution x = x0 + s^2 removes the root at the start.
    x0, x1 = np.arcsin(-0.6), np.arcsin(WALL)
    speed = lambda x: np.sqrt(2 * 9.81 * (np.cos(x) - np.cos(x0)))
    exact, _ = quad(
        lambda s: 2 * s / speed(x0 + s * s), 0, np.sqrt(x1 - x0), epsabs=1e-14, epsrel=1e-13
    )
    errors = []
    for steps in (8, 16):
        sol = swinging(1.28 / steps, 1.0, steps, scheme, max_events=2)
        errors.append(abs(float(sol.events.ts[0]) - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.4)


# What events do --------------------------------------------------------------------------


def below(q, v, t, args):
    return q[0] - 0.25


def test_a_terminal_event_ends_the_run():
    event = ej.Event(below, direction=-1, terminal=True)
    sol = falling(jnp.array([1.0, 0.9, 9.81, 0.01]), 1.0, event, saveat=ej.SaveAt(every=1))
    exact = np.sqrt(1.5 / 9.81)
    assert sol.result == ej.RESULTS.successful
    np.testing.assert_allclose(sol.events.ts[0], exact, rtol=1e-14)
    np.testing.assert_allclose(sol.end.q[0], 0.25, rtol=1e-14)
    reached = np.asarray(sol.ts) <= exact
    assert np.all(np.isfinite(sol.ys.q[reached]))
    assert np.all(np.isnan(sol.ys.q[~reached]))


def test_a_direction_selects_zeros():
    swings = [swinging_freely(direction).events.count for direction in (-1, 0, 1)]
    assert [int(n) for n in swings] == [2, 4, 2]


def swinging_freely(direction) -> Any:
    start = ej.State([1.0], [0.0])
    spring = ej.System(jnp.eye(1), lambda q, args: 0.5 * q @ q)
    event = ej.Event(lambda q, v, t, args: q[0], direction=direction)
    return ej.simulate(
        spring, ej.EnergyPreserving(), start, h=0.1, num_steps=125, events=event
    )


def test_a_reset_changes_the_state():
    # A ball on a floor, by a reset of one's own in place of an `Impact`.
    event = ej.Event(
        lambda q, v, t, args: q[0],
        direction=-1,
        reset=lambda q, v, t, args: (q, -0.9 * v),
    )
    sol = falling(jnp.array([1.0, 0.9, 9.81, 0.01]), events=event)
    np.testing.assert_allclose(sol.events.ts[:7], BOUNCES[:7], rtol=2e-14)  # round-off


def test_two_events_at_once():
    both = (
        ej.Event(below, direction=-1),
        ej.Event(lambda q, v, t, args: q[0] - 0.25, direction=-1),
        ej.Event(lambda q, v, t, args: q[0] - 0.5, direction=-1),
    )
    sol = falling(jnp.array([1.0, 0.9, 9.81, 0.4]), 0.4, both, max_steps=2)
    happened = np.asarray(sol.events.happened[:2])
    assert int(sol.events.count) == 2
    assert happened.tolist() == [[False, False, True], [True, True, False]]
    np.testing.assert_allclose(
        sol.events.ts[:2], np.sqrt(np.array([1.0, 1.5]) / 9.81), rtol=1e-14
    )


def test_more_events_than_allowed_are_a_failure():
    sol = falling(jnp.array([1.0, 0.9, 9.81, 0.01]), max_events=3, throw=False)
    assert sol.result == ej.RESULTS.too_many_events


# Bad input -------------------------------------------------------------------------------

NO_FUNCTION: Any = 1.0


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: ej.Event(NO_FUNCTION), TypeError, "`fn` must be a function"),
        (lambda: ej.Event(below, direction=2), ValueError, "direction"),
        (lambda: ej.Impact(NO_FUNCTION), TypeError, "`gap` must be a function"),
        (lambda: ej.Impact(height, 1.5), ValueError, r"\[0, 1\]"),
    ],
)
def test_wrong_events_are_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (dict(events=[below]), TypeError, "`events` must be"),
        (dict(max_events=0), ValueError, "max_events"),
        (dict(progress=True), ValueError, "piece by piece"),
        (dict(events=ej.Event(lambda q, v, t, args: q)), ValueError, "scalar"),
    ],
)
def test_wrong_runs_with_events_are_refused(options, error, words):
    with pytest.raises(error, match=words):
        falling(jnp.array([1.0, 0.9, 9.81, 0.01]), **options)


def test_schemes_that_remember_their_step_are_refused():
    start = ej.State([1.0], [0.0])
    with pytest.raises(ValueError, match="GeneralizedAlpha"):
        ej.simulate(
            BALL,
            ej.GeneralizedAlpha(0.8),
            start,
            dict(g=1.0),
            h=0.1,
            num_steps=3,
            events=ej.Impact(height, 1.0),
        )
