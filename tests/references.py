"""Solutions that are independent of the package: other methods, and the literature."""

import functools
from types import SimpleNamespace

import numpy as np
import scipy
from scipy.integrate import solve_ivp


# References in minimal coordinates, by an explicit method of order 8 -------------------


def _integrate(rates, start, t):
    return solve_ivp(rates, (0, t), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


@functools.cache
def pendulum_reference(t, g=9.81, l=1.0):
    """Angle from the vertical and its rate; released from the horizontal at rest."""
    return _integrate(lambda _, y: [y[1], -g / l * np.sin(y[0])], [np.pi / 2, 0.0], t)


@functools.cache
def double_pendulum_reference(t, m1=1.0, m2=1.0, g=9.81, outer=np.pi / 2):
    """Points and velocities of two unit rods; angles from +x towards +y, gravity +y.

    The inner rod starts horizontal, the outer one at the angle `outer`.
    """

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

    a, b, da, db = _integrate(rates, [0.0, outer, 0.0, 0.0], t)
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


def four_bar_of_beams(t, pins, EA, GA, EI, rhoA, rhoI, g=9.81):
    """Three beams of two elements each between four pins, which fall from rest.

    The places of the pins are shared, so the equations have no constraints. Returns the
    places and angles of the three sections of each beam, shape `(27,)`.
    """
    chords = np.diff(pins, axis=0)
    lengths, angles = np.hypot(*chords.T), np.arctan2(chords[:, 1], chords[:, 0])
    # Simpson's rule for the masses, halves of the elements for the rotations.
    masses, inertias = np.zeros(7), np.kron(lengths, [1, 2, 1]) * rhoI / 4
    for k in range(3):
        masses[2 * k : 2 * k + 3] += rhoA * lengths[k] * np.array([1, 4, 1]) / 6
    # The first place and the first angle of each element, and its length.
    place, angle = np.arange(6), np.array([0, 1, 3, 4, 6, 7])
    size = np.repeat(lengths, 2) / 2

    def places_and_angles(y):
        x = np.concatenate([pins[:1], y[:10].reshape(5, 2), pins[3:]])
        return x, y[10:19]

    def rates(_, y):
        x, turned = places_and_angles(y)
        along = (x[place + 1] - x[place]) / size[:, None]
        middle = (turned[angle] + turned[angle + 1]) / 2
        c, s = np.cos(middle), np.sin(middle)
        stretch, shear = (
            c * along[:, 0] + s * along[:, 1],
            c * along[:, 1] - s * along[:, 0],
        )
        normal, across = EA * (stretch - 1), GA * shear
        moment = EI * (turned[angle + 1] - turned[angle]) / size
        pull = np.stack([c * normal - s * across, s * normal + c * across], axis=1)
        couple = (across * stretch - normal * shear) * size / 2
        force, torque = np.outer(masses, [0.0, -g]), np.zeros(9)
        np.add.at(force, place, pull)
        np.add.at(force, place + 1, -pull)
        np.add.at(torque, angle, couple + moment)
        np.add.at(torque, angle + 1, couple - moment)
        accelerations = (force / masses[:, None])[1:6].ravel(), torque / inertias
        return np.concatenate([y[19:], *accelerations])

    middles = (pins[:-1] + pins[1:]) / 2
    x = np.concatenate([np.stack([pins[:-1], middles], axis=1).reshape(6, 2), pins[3:]])
    start = np.concatenate([x[1:6].ravel(), np.repeat(angles, 3), np.zeros(19)])
    x, turned = places_and_angles(_integrate(rates, start, t))
    of_beam = lambda k: np.column_stack([x[2 * k : 2 * k + 3], turned[3 * k : 3 * k + 3]])
    return np.concatenate([of_beam(k).ravel() for k in range(3)])


def point_on_rod(t):
    """Case b from the angle of case a: the same motion, with gravity along +y."""
    angle, rate = pendulum_reference(t)
    return SimpleNamespace(
        q=np.array([np.sin(angle), np.cos(angle)]),
        v=rate * np.array([np.cos(angle), -np.sin(angle)]),
    )


# Published values ------------------------------------------------------------------------

# O. Bruls, A. Cardona and M. Arnold, Mech. Mach. Theory 48 (2012) 121-137: a fast heavy
# top. Position and velocity of the mass centre, unit quaternion (scalar first), angular
# velocity in body axes, force of the joint on the top.
HEAVY_TOP = {
    t: SimpleNamespace(
        position=np.array(x),
        quaternion=np.array(p),
        spin=np.array(w),
        velocity=np.array(v),
        force=np.array(f),
    )
    for t, x, p, w, v, f in [
        (
            0.0,
            [0.0, 1.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 150.0, -4.61538],
            [4.61538, 0.0, 0.0],
            [0.0, -319.525988166, -317.26246153846233],
        ),
        (
            0.1,
            [0.4212966589253676, 0.8945719743456051, -0.1491647005619256],
            [
                0.3318229126082974,
                0.177338056666916,
                0.9149751591387325,
                -0.1458260144308938,
            ],
            [4.808941331728258, 150.0, 1.0283007567175237],
            [3.4085374633391927, -2.083437950579205, -2.8678350450069012],
            [-361.0560047871492, -295.39317301122185, -212.26717185507331],
        ),
        (
            0.2,
            [0.6055505613769885, 0.5989576817949837, -0.5239830274300812],
            [
                -0.7082791529743369,
                0.4387810881265612,
                0.5457283961454157,
                0.08939975282392648,
            ],
            [-2.6915909121418746, 150.0, 4.917260989894856],
            [-0.04016303361104526, -3.667823788207261, -4.239053298846167],
            [-640.2364079920736, -148.6277113469621, 136.92931303857952],
        ),
        (
            1.0,
            [0.17334396409822422, 0.6400885920701663, -0.7484907911339629],
            [
                0.7329439806797752,
                -0.27828571933799107,
                0.5318246113338199,
                -0.3201761427362346,
            ],
            [-0.8220781016919674, 150.0, -5.92329134811611],
            [0.5708253034208872, -4.588728296336887, -3.7919551547084853],
            [-517.600739476853, -396.84310148917467, 404.57492516342825],
        ),
    ]
}

# P. L. Kinon and P. Betsch, Multibody Syst. Dyn. (2024): a free asymmetric body.
FREE_BODY = {
    0.5: SimpleNamespace(
        quaternion=np.array(
            [
                0.9956041288587546,
                0.03279843401548702,
                0.07696178914855388,
                0.042113707229189126,
            ]
        ),
        spin=np.array([10.712038516938247, 19.833393654774117, 19.702836969566214]),
    )
}

# O. Gonzalez, Physica D 132 (1999) 165-174: four particles; positions and velocities.
FOUR_PARTICLES = {
    1.0: (
        np.array(
            [
                0.007984327723434572,
                0.011392149426950257,
                0.0004151028604671534,
                0.9857299206523148,
                0.2068880725807973,
                0.07653934038294397,
                0.24273202080835707,
                0.9799405709726915,
                0.08876545776987246,
                0.6920836838002359,
                0.655341364466746,
                0.921062543011761,
            ]
        ),
        np.array(
            [
                0.026641236990204993,
                0.041158136253202436,
                0.0023800713135244235,
                -0.05164297129974394,
                0.35321685414722354,
                0.2064653012501718,
                0.4041282330507696,
                -0.06872699026865176,
                0.2242114272390265,
                -0.4712983877104376,
                -0.5545509535746908,
                0.5073751425212939,
            ]
        ),
    )
}

# Test Set for IVP Solvers, release 2.4, car axis problem at t = 3, given to 21 digits:
# both wheels, their velocities.
CAR_AXIS = SimpleNamespace(
    q=np.array(
        [
            0.0493455784275402809,
            0.496989460230171154,
            1.04174252488542152,
            0.373911027265361257,
        ]
    ),
    v=np.array(
        [
            -0.0770583684040972358,
            0.00744686658723778553,
            0.0175568157537232222,
            0.770341043779251976,
        ]
    ),
)


def cantilever_by_shooting(stiffness, length, force, steps=10):
    """The displacement of the tip of a straight beam along x under a force at its tip.

    The ordinary differential equations of the static beam are integrated from the clamp,
    and Newton's method finds the moment there for which that at the tip vanishes. The
    stiffness is that of stretch, shear, torsion and bending, `(6, 6)`.
    """
    flexibility, force = np.linalg.inv(stiffness), np.asarray(force)

    def rates(s, y, load):
        rotation, moment = y[3:12].reshape(3, 3), y[12:]
        strain = flexibility @ np.append(rotation.T @ load, rotation.T @ moment)
        slope = rotation @ (strain[:3] + np.eye(3)[0])
        turning = np.cross(np.eye(3), strain[3:])  # minus the matrix of the cross product
        return np.concatenate(
            [slope, -(rotation @ turning.T).ravel(), -np.cross(slope, load)]
        )

    def tip(moment, load):
        first = np.concatenate([np.zeros(3), np.eye(3).ravel(), moment])
        return scipy.integrate.solve_ivp(
            rates, (0.0, length), first, args=(load,), method="DOP853", rtol=1e-12,
            atol=1e-12,
        ).y[:, -1]  # fmt: skip

    size = length * np.linalg.norm(force)
    moment = np.zeros(3)
    for load in force * np.arange(1, steps + 1)[:, None] / steps:
        for _ in range(8):
            left = tip(moment, load)[12:]
            columns = [
                (tip(moment + 1e-6 * size * unit, load)[12:] - left) / (1e-6 * size)
                for unit in np.eye(3)
            ]
            moment = moment - np.linalg.solve(np.stack(columns, axis=1), left)
    assert np.abs(tip(moment, force)[12:]).max() < 1e-9 * size
    return tip(moment, force)[:3] - np.array([length, 0.0, 0.0])
