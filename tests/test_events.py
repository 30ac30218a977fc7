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


@pytest.mark.slow  # A notebook shows it, too.
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


@pytest.mark.slow
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
    [
        (ej.EnergyPreserving(), 2),
        pytest.param(ej.Composed(ej.EnergyPreserving(), 4), 4, marks=pytest.mark.slow),
    ],
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyDecaying(0.5),
        ej.EnergyConsistent(0.0),
        ej.EnergyConsistent(0.5),
        ej.KappaDecaying(0.5),
        ej.Rattle(),
        ej.Composed(ej.Rattle(), 4),
        ej.Composed(ej.EnergyConsistent(0.0), 6),
    ],
    ids=repr,
)
def test_all_schemes_of_any_length_end_steps_at_events(scheme):
    sol = swinging(0.01, 0.7, 300, scheme, max_events=4)
    assert int(sol.events.count) == 2
    # By quadrature 0.8249384; the errors are those of the schemes.
    assert abs(sol.events.ts[0] - 0.8249384) < 2e-4
    np.testing.assert_allclose(sol.events.before.q[:2, 0], WALL, rtol=1e-14)
    assert np.abs(sol.audit.leak).max() < 1e-13  # round-off
    speeds = [np.linalg.norm(x.v[0]) for x in (sol.events.before, sol.events.after)]
    np.testing.assert_allclose(speeds[1], 0.7 * speeds[0], rtol=1e-12)


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


@pytest.mark.slow
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


# Functions of all kinds -----------------------------------------------------------------

# A ball in the plane, of which every step is exact.
THROWN = ej.System(jnp.eye(2), lambda q, args: args["g"] * q[1])


def anything(q, v, t, args):
    c = args["c"]
    sine = jnp.sin(args["w"] * t + args["phase"])
    rest = c[3] * v[1] + c[4] * sine + c[5] * q[0] * q[1]
    return c[0] + c[1] * q[0] + c[2] * q[1] + rest


def test_all_zeros_of_a_hundred_random_functions_are_found():
    # Up to three periods of the sine are in twenty steps: functions are zero at the start,
    # twice in a step, and nearly touch zero.
    from scipy.optimize import brentq

    rng = np.random.default_rng(1)
    lanes, h, num_steps = 100, 0.05, 20
    args = dict(
        c=rng.normal(size=(lanes, 6)),
        w=rng.uniform(1, 25, lanes),
        phase=rng.uniform(0, 6, lanes),
        g=rng.uniform(1, 8, lanes),
    )
    at_start = slice(None, None, 10)
    args["c"][at_start, 0] = -(
        3 * args["c"][at_start, 3]
        + args["c"][at_start, 4] * np.sin(args["phase"][at_start])
    )

    def run(args) -> Any:
        return ej.simulate(
            THROWN,
            ej.EnergyPreserving(),
            ej.State([0.0, 0.0], [1.0, 3.0]),
            args,
            h=h,
            num_steps=num_steps,
            events=[ej.Event(anything), ej.Event(anything, direction=1)],
            throw=False,
        )

    sol = jax.device_get(jax.jit(jax.vmap(run))(args))
    assert np.all(sol.result == ej.RESULTS.successful)
    times = np.linspace(1e-9, h * num_steps, 200001)
    for k in range(lanes):
        own = {key: value[k] for key, value in args.items()}

        def exact(t, own=own):
            g = own["g"]
            q, v = (t, 3 * t - 0.5 * g * t**2), (1.0, 3 - g * t)
            c, sine = own["c"], np.sin(own["w"] * t + own["phase"])
            rest = c[3] * v[1] + c[4] * sine + c[5] * q[0] * q[1]
            return c[0] + c[1] * q[0] + c[2] * q[1] + rest

        values = exact(times)
        changes = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))
        zeros: Any = [brentq(exact, *times[j : j + 2], xtol=1e-15) for j in changes]
        found = sol.events.ts[k][: sol.events.count[k]]
        # Functions vanish at the start to round-off only, and may have another zero near.
        later = found > 1e-12
        found, rising = found[later], sol.events.happened[k][: later.size, 1][later]
        np.testing.assert_allclose(found, zeros, atol=1e-12, err_msg=str(k))  # round-off
        np.testing.assert_array_equal(rising, values[changes] < 0)


# Events that change a law ----------------------------------------------------------------


def test_dry_friction_changes_its_sign_where_the_motion_turns():
    # x'' + x = -sign(x'): each swing is half a period about -1 or 1, exact in closed form.
    system = ej.System(
        jnp.eye(1),
        lambda q, args: 0.5 * q @ q,
        force=lambda q, v, t, args: -args["sign"] * jnp.ones(1),
    )
    turn = ej.Event(
        lambda q, v, t, args: v[0], reset_args=lambda q, v, t, args: {"sign": -args["sign"]}
    )
    ts = jnp.linspace(0.0, 12.0, 25)
    sol: Any = ej.simulate(
        system,
        ej.EnergyPreserving(),
        ej.State([12.0], [6.0]),
        dict(sign=1.0),
        h=0.01,
        t1=12.0,
        events=turn,
        saveat=ej.SaveAt(ts=ts),
    )
    first = np.sqrt(13.0**2 + 6**2) - 1
    exact = [first, -(first - 2), first - 4, -(first - 6)]
    count = int(sol.events.count)
    # Midpoint steps keep the energy of a harmonic motion, so turning points are exact.
    np.testing.assert_allclose(sol.events.before.q[:count, 0], exact[:count], rtol=1e-12)
    assert count == 4
    # Rows within steps that an event has ended; of order 2.
    phase = np.arctan2(6, 13)
    early = np.asarray(ts) < phase
    np.testing.assert_allclose(
        sol.ys.q[early, 0],
        -1 + np.hypot(13, 6) * np.cos(np.asarray(ts)[early] - phase),
        atol=1e-4,
    )
    # The force is counted with the sign that it had.
    assert np.abs(sol.audit.leak).max() < 1e-12


# Gaps that stay closed -------------------------------------------------------------------


@pytest.fixture(scope="module")
def resting():
    return falling(jnp.array([1.0, 0.5, 9.81, 0.01]), 2.0, max_steps=200, max_events=30)


def test_bounces_that_accumulate_end_in_rest(resting):
    count = int(resting.events.count)
    limit = FIRST * (1 + 0.5) / (1 - 0.5)
    # The last hit is that of which the next would follow within a step.
    times = FIRST * (2 * np.cumsum(0.5 ** np.arange(12)) - 1)
    last = np.argmax(np.diff(times) < 0.01)
    assert count == last + 1
    np.testing.assert_allclose(resting.events.ts[:count], times[:count], rtol=1e-13)
    assert abs(resting.events.ts[count - 1] - limit) < 0.01 / (1 - 0.5)
    assert np.asarray(resting.events.closed[:count, 0]).tolist() == [False] * last + [True]
    assert np.abs(resting.end.q[0]) < 1e-15
    assert np.abs(resting.end.v[0]) < 1e-15
    # All of the energy is gone, and the floor carries the weight.
    np.testing.assert_allclose(resting.audit.impact.sum(), 9.81, rtol=1e-13)
    np.testing.assert_allclose(resting.events.contact_forces[-1], 9.81, rtol=1e-10)
    assert resting.multipliers.shape[1] == 0


@pytest.mark.slow
def test_a_particle_leaves_a_sphere_where_the_force_would_pull():
    # From energy and Newton's law: at the height 2/3 + v0^2/(3 g) of a sphere of radius 1.
    v0 = 0.3
    particle = ej.System(jnp.eye(2), lambda q, args: 9.81 * q[1])
    sol: Any = ej.simulate(
        particle,
        ej.EnergyPreserving(),
        ej.State([0.0, 1.0], [v0, 0.0]),
        h=0.02,
        t1=1.0,
        saveat=ej.SaveAt(every=1),
        events=ej.Impact(lambda q, args: jnp.sqrt(q @ q) - 1, 0.5),
    )
    assert sol.events.count == 1
    # The height is a matter of energy and not of time, so there is round-off alone.
    height = 2 / 3 + v0**2 / (3 * 9.81)
    np.testing.assert_allclose(sol.events.before.q[0, 1], height, rtol=1e-10)
    held = np.asarray(sol.ts) < float(sol.events.ts[0])
    radius = np.linalg.norm(sol.ys.q, axis=1)
    assert np.abs(radius[held] - 1).max() < 1e-14
    assert np.all(radius[~held] > 1)
    forces = np.asarray(sol.events.contact_forces[:, 0])
    assert np.all(forces[held][1:] > 0)
    assert np.all(forces[~held][1:] == 0)


@pytest.mark.slow
def test_a_growing_force_lifts_a_block_and_the_time_has_derivatives():
    block = ej.System(
        jnp.eye(1), lambda q, a: 9.81 * q[0], force=lambda q, v, t, a: jnp.stack([a * t**2])
    )

    def lifted(a) -> Any:
        floor = ej.Impact(lambda q, a: q[0], 0.5)
        sol: Any = ej.simulate(
            block,
            ej.EnergyPreserving(),
            ej.State([0.0], [0.0]),
            a,
            h=0.013,
            t1=1.3,
            max_steps=110,
            events=floor,
        )
        return sol.events.ts[0]

    time, slope = jax.jit(lambda a: jax.jvp(lifted, (a,), (jnp.ones(()),)))(8.0)
    exact = np.sqrt(9.81 / 8)
    np.testing.assert_allclose(time, exact, rtol=1e-12)  # round-off
    np.testing.assert_allclose(slope, -0.5 * exact / 8, rtol=1e-11)


def test_a_start_with_a_closed_gap_is_a_failure():
    for q, v in ((-1e-3, 0.0), (0.0, -1.0)):
        sol: Any = ej.simulate(
            BALL,
            ej.EnergyPreserving(),
            ej.State([q], [v]),
            dict(g=9.81),
            h=0.01,
            num_steps=3,
            events=ej.Impact(height, 0.5),
            throw=False,
        )
        assert sol.result == ej.RESULTS.gap_closed_at_start


@pytest.mark.slow
def test_derivatives_of_impacts_at_once_are_those_of_each():
    # Two balls that do not know of each other hit the floor at the same time.
    balls = ej.System(jnp.eye(2), lambda q, args: 9.81 * jnp.sum(q))
    floors = [ej.Impact(lambda q, args, k=k: q[k]) for k in range(2)]

    def end(heights) -> Any:
        start = ej.State(heights, jnp.zeros(2))
        scheme = ej.EnergyPreserving()
        return ej.simulate(balls, scheme, start, h=0.05, num_steps=16, events=floors).end.q

    slopes = jax.jit(jax.jacfwd(end))(jnp.ones(2))
    # Of one ball, elastic, by its height.
    first, t1 = np.sqrt(2 / 9.81), 0.8
    exact = 9.81 * (0.5 * first / 1) * (t1 - 2 * first) + 9.81 * (t1 - first) * 0.5 * first
    np.testing.assert_allclose(slopes, exact * np.eye(2), atol=1e-12)


def bad(event, system=PENDULUM, args=None, state=None):
    state = ej.initial_state(PENDULUM, [-0.6, -0.8], [0.0, 0.0]) if state is None else state
    scheme = ej.EnergyPreserving()
    return ej.simulate(
        system, scheme, state, args, h=0.02, num_steps=30, events=event, throw=False
    ).result


@pytest.mark.parametrize(
    "change",
    [
        dict(reset=lambda q, v, t, args: (1.2 * q, v)),
        dict(reset=lambda q, v, t, args: (q, v + 1.0)),
    ],
)
def test_a_reset_must_satisfy_the_constraints(change):
    event = ej.Event(lambda q, v, t, args: q[0] + 0.5, direction=1, **change)
    assert bad(event) == ej.RESULTS.inconsistent_reset


def test_restitutions_of_args_are_checked():
    floor = ej.Impact(height, lambda args: args["e"])
    args, start = dict(g=9.81, e=1.5), ej.State([0.1], [0.0])
    assert bad(floor, BALL, args, start) == ej.RESULTS.restitution_out_of_range


def test_a_function_that_stays_zero_is_no_event():
    event = ej.Event(lambda q, v, t, args: jnp.maximum(q[0] + 0.5, 0.0))
    sol: Any = swinging_events(event)
    assert sol.events.count == 0


def swinging_events(event) -> Any:
    start = ej.initial_state(PENDULUM, [-0.6, -0.8], [0.0, 0.0])
    return ej.simulate(
        PENDULUM, ej.EnergyPreserving(), start, h=0.02, num_steps=40, events=event
    )


@pytest.mark.slow
@pytest.mark.parametrize("e", [1.0, 0.5, 0.0])
def test_a_rod_that_falls_flat_hits_with_both_ends(e):
    # By symmetry the rod must not turn, and its centre moves like a ball.
    rod = ej.System(jnp.diag(jnp.array([1.0, 1.0, 1 / 12])), lambda q, args: 9.81 * q[1])
    ends = [
        ej.Impact(lambda q, args, side=side: q[1] + side * 0.5 * jnp.sin(q[2]), e)
        for side in (-1, 1)
    ]
    sol: Any = ej.simulate(
        rod,
        ej.EnergyPreserving(),
        ej.State([0.0, 1.0, 0.0], jnp.zeros(3)),
        h=0.01,
        num_steps=60,
        events=ends,
    )
    before, after = sol.events.before.v[0], sol.events.after.v[0]
    energy = lambda v: 0.5 * (v[1] ** 2 + v[2] ** 2 / 12)
    lost = (1 - e**2) * energy(before)
    if e != 0.5:
        # In turn the ends are hit without loss, or until both are at rest.
        np.testing.assert_allclose(energy(before) - energy(after), lost, atol=1e-8)
    assert np.all(np.asarray(sol.events.happened[0]))
    assert np.abs(sol.audit.leak).max() < 1e-13


def test_a_controller_goes_on_with_the_length_that_it_had():
    controlled = falling(
        jnp.array([1.0, 0.9, 9.81, 0.01]),
        1.5,
        max_steps=None,
        controller=ej.StepController(1e-6, 1e-6),
    )
    np.testing.assert_allclose(controlled.events.ts[:2], BOUNCES[:2], rtol=1e-13)
    # Steps of a parabola have no error, so they become long whatever the events.
    assert controlled.stats.completed_steps < 20
    assert controlled.stats.rejected_steps == 0


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
        (dict(events=ej.Event(lambda q, v, t, args: q[0] < 0.5)), TypeError, "a float"),
        (dict(events=ej.Event(below, reset=lambda q, *_: q)), TypeError, "the pair"),
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
