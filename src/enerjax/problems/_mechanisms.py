"""Mechanisms that are made as scenes; gravity acts along -y in the plane, -z in space."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .._types import Real
from ..scenes import bodies, forces, joints, Scene, shapes
from ._base import Problem, problem_of


_EARTH = (0.0, -9.81)


def point_pendulum(g: Real = 9.81) -> Problem:
    """A point on a rod of length 1, at rest on the left of its pivot; y is up.

    **Source:** IFToMM multibody benchmark A01.
    """
    point = bodies.PointMass("point", 1.0, [-1.0, 0.0])
    rod = joints.Distance("rod", "ground", "point")
    return problem_of(Scene([point, rod], gravity=jnp.array([0.0, -1.0]) * g))


def slider_crank(
    crank: Real = 0.15, rod: Real = 0.35, mass: Real = 1.0, speed: Real = 40.0
) -> Problem:
    """A slider-crank without friction, the crank upright and turning; gravity along -y.

    Coordinates `(x, y, angle)` of the crank, the rod and the slider.
    """
    top = jnp.array([0.0, crank])
    pin = jnp.array([(rod**2 - crank**2) ** 0.5, 0.0])
    moving = jnp.array([-1.0, 0.0]) * speed * crank
    parts = [
        bodies.PlanarBody.rod("crank", mass, [0, 0], top, moving / 2, speed),
        bodies.PlanarBody.rod("rod", mass, top, pin, moving),
        bodies.PlanarBody("slider", mass, 1e-3, pin, velocity=moving),
        joints.Revolute("shaft", "ground", "crank", [0.0, 0.0]),
        joints.Revolute("big end", "crank", "rod", [crank / 2, 0.0]),
        joints.Revolute("small end", "slider", "rod", [0.0, 0.0]),
        joints.Prismatic("guide", "ground", "slider", axis=[1.0, 0.0]),
    ]
    return problem_of(Scene(parts, gravity=_EARTH))


def four_bar(
    ground: Real = 1.0, crank: Real = 0.4, coupler: Real = 0.9, rocker: Real = 0.8
) -> Problem:
    """A four-bar linkage of uniform rods, 1 kg a metre, released with the crank upright."""
    base, top = jnp.array([ground, 0.0]), jnp.array([0.0, crank])
    span = jnp.sqrt(jnp.sum((base - top) ** 2))
    along = (base - top) / span
    reach = (span**2 + coupler**2 - rocker**2) / (2 * span)
    rise = jnp.sqrt(coupler**2 - reach**2)
    knee = top + reach * along + rise * jnp.array([-along[1], along[0]])
    parts = [
        bodies.PlanarBody.rod("crank", crank, [0.0, 0.0], top),
        bodies.PlanarBody.rod("coupler", coupler, top, knee),
        bodies.PlanarBody.rod("rocker", rocker, base, knee),
        joints.Revolute("A", "ground", "crank", [0.0, 0.0]),
        joints.Revolute("B", "crank", "coupler", [crank / 2, 0.0]),
        joints.Revolute("C", "coupler", "rocker", [coupler / 2, 0.0]),
        joints.Revolute("D", "ground", "rocker", base),
    ]
    return problem_of(Scene(parts, gravity=_EARTH))


def parallel_bars(num_cells: int = 2, speed: Real = 1.0) -> Problem:
    """Upright rods on the ground, joined at their tops by level rods: N four-bars in a row.

    Rods of 1 m and 1 kg. The mechanism is singular when all rods are horizontal, because it
    could fold there. Coordinates `(x, y, angle)` of the uprights and level rods in turn.

    **Source:** IFToMM multibody benchmark A02 (N = 2; N = 40).
    """
    parts: list = []
    foot, top = [-0.5, 0.0], [0.5, 0.0]
    rod, moving = bodies.PlanarBody.rod, jnp.array([1.0, 0.0]) * speed
    for k in range(num_cells + 1):
        upright = f"upright {k}"
        parts += [
            rod(upright, 1.0, [k, 0], [k, 1], moving / 2, -moving[0]),
            joints.Revolute(f"foot {k}", "ground", upright, [k, 0]),
        ]
        if k > 0:
            parts.append(joints.Revolute(f"right {k}", f"level {k}", upright, top, top))
        if k < num_cells:
            level = f"level {k + 1}"
            parts += [
                rod(level, 1.0, [k, 1], [k + 1, 1], moving),
                joints.Revolute(f"left {k + 1}", upright, level, top, foot),
            ]
    return problem_of(Scene(parts, gravity=_EARTH))


# Andrews' mechanism, with the names of the source. For each body: mass, inertia, angle, a
# point, and the mass centre relative to this point in the axes of the body.
_BETA, _THETA, _GAMMA = -0.06171389001427645, 0.0, 0.45527981916307037
_PHI, _DELTA = 0.22266839016588588, 0.48736497954384256
_OMEGA, _EPSILON = -0.22266839016588588, 1.2305474445498212
_BODIES = dict(
    K1=(0.04325, 2.194e-6, _BETA, "O", (0.00092, 0.0)),
    K2=(0.00365, 4.410e-7, _BETA + _THETA, "F", (-0.0115, 0.0)),
    K3=(0.02373, 5.255e-6, _GAMMA, "B", (0.01043, -0.01874)),
    K4=(0.00706, 5.667e-7, _PHI + _DELTA, "G", (0.0, -0.00579)),
    K5=(0.07050, 1.169e-5, _DELTA, "A", (0.02308, 0.00916)),
    K6=(0.00706, 5.667e-7, _OMEGA + _EPSILON, "H", (0.00579, 0.0)),
    K7=(0.05498, 1.912e-5, _EPSILON, "A", (-0.00449, -0.01228)),
)
_PINS = (
    ("O", "ground", "K1"), ("F", "K1", "K2"), ("E3", "K2", "K3"), ("E4", "K2", "K4"),
    ("E6", "K2", "K6"), ("B", "ground", "K3"), ("G", "K5", "K4"), ("A5", "ground", "K5"),
    ("H", "K7", "K6"), ("A7", "ground", "K7"),
)  # fmt: skip


def squeezer(torque: Real = 0.033) -> Problem:
    """Andrews' squeezing mechanism: seven bodies, ten pins, a spring and a motor's torque.

    Coordinates `(x, y, angle)` of the bodies K1 to K7, whose angles are in the source
    `beta`, `beta + Theta`, `gamma`, `Phi + delta`, `delta`, `Omega + epsilon`, `epsilon`.
    No gravity; the drive starts at rest and passes 1000 rad/s within 0.03 s.

    **Source:** Test Set for IVP Solvers, Andrews' squeezing mechanism; IFToMM A03.
    """
    points = dict(O=np.zeros(2), A=np.array([-0.06934, -0.00227]))
    points["B"] = np.array([-0.03635, 0.03273])
    points["F"] = _turned(_BETA, (0.007, 0.0))
    points["E"] = points["F"] - _turned(_BETA + _THETA, (0.028, 0.0))
    points["G"] = points["A"] + _turned(_DELTA, (0.04, 0.0))
    points["H"] = points["A"] + _turned(_EPSILON, (0.0, -0.04))
    points["D"] = points["B"] + _turned(_GAMMA, (0.02, -0.018))
    centres = {"ground": np.zeros(2)}
    parts = []
    for name, (mass, inertia, angle, base, centre) in _BODIES.items():
        centres[name] = points[base] + _turned(angle, centre)
        parts.append(bodies.PlanarBody(name, mass, inertia, centres[name], angle))

    def within(body: str, point: str) -> np.ndarray:
        """A point in the frame of a body."""
        angle = 0.0 if body == "ground" else _BODIES[body][2]
        return _turned(-angle, points[point] - centres[body])

    parts += [joints.Revolute(pin, a, b, within(a, pin[0])) for pin, a, b in _PINS]
    hook = within("K3", "D")
    parts += [
        forces.Spring("spring", "ground", "K3", 4530.0, 0.07785, [0.014, 0.072], hook),
        forces.ConstantTorque("motor", "K1", torque),
    ]
    return problem_of(Scene(parts))


def _turned(angle: float, x: Sequence[float] | np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * x[0] - s * x[1], s * x[0] + c * x[1]])


def spatial_four_bar(speed: Real = 20.0) -> Problem:
    """A spatial four-bar: crank and rocker turn about skew pins, a coupler joins them.

    The crank, a flywheel, turns about x, the rocker about y; gravity acts along -z. There
    are two degrees of freedom, because the coupler can spin about its axis between its ball
    joints. Each body has twelve coordinates, the mass centre and the body axes.
    """
    pin, knee, base = np.array([0.0, 0.0, 0.15]), np.array([0.4, 0.5, 0.5]), (0.4, 0.5, 0.0)
    axis_a, axis_d = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    spin = jnp.array([speed, 0.0, 0.0])
    parts = [
        bodies.RigidBody(
            "crank", 2.0, [4e-2, 3e-2, 3e-2], [0.0, 0.0, 0.0], angular_velocity=spin
        ),
        bodies.RigidBody("coupler", 1.0, [5e-2, 5e-2, 5e-2], (pin + knee) / 2),
        bodies.RigidBody("rocker", 0.8, [2e-2, 2e-2, 2e-3], (knee + base) / 2),
        joints.Revolute("A", "ground", "crank", [0.0, 0.0, 0.0], axis=axis_a),
        joints.Spherical("B", "crank", "coupler", pin),
        joints.Spherical("C", "rocker", "coupler", [0.0, 0.0, 0.25]),
        joints.Revolute("D", "ground", "rocker", base, axis=axis_d),
    ]
    return problem_of(Scene(parts, gravity=(0.0, 0.0, -9.81)))


def steady_top(precession: Real = 10.0) -> Problem:
    """A cone that precesses steadily about its tip at 60 degrees from the vertical.

    With the spin about its axis that belongs to the `precession` its rotation is
    `Rz(precession t) Rx(pi/3) Rz(spin t)`, so its height is constant. The coordinates are
    the mass centre, which is 0.075 from the tip, and the body axes.

    **Source:** P. L. Kinon and P. Betsch, Multibody Syst. Dyn. (2024).
    """
    density, height, radius, gravity, tilt = 2700.0, 0.1, 0.05, 9.81, np.pi / 3
    mass, centre = density * np.pi * radius**2 * height / 3, 0.75 * height
    axial = 0.3 * mass * radius**2
    across = mass * (0.15 * radius**2 + 0.0375 * height**2)
    # Steady precession: the moment of the weight turns the angular momentum.
    swing = (across + mass * centre**2 - axial) * np.cos(tilt)
    spin = (mass * gravity * centre / precession + swing * precession) / axial
    axis = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    turning = spin * axis + jnp.array([0.0, 0.0, 1.0]) * precession
    c, s = axis[2], -axis[1]
    top = bodies.RigidBody(
        "top",
        mass,
        [across, across, axial],
        centre * axis,
        np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        velocity=jnp.cross(turning, centre * axis),
        angular_velocity=turning,
        shape=_cone(radius, height),
    )
    tip = joints.Spherical("tip", "ground", "top", [0.0, 0.0, 0.0])
    return problem_of(Scene([top, tip], gravity=[0.0, 0.0, -gravity]))


def _cone(radius: float, height: float, sides: int = 32) -> shapes.Mesh:
    """A cone about the third axis, whose tip points down; its mass centre is the origin."""
    turn = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], axis=1)
    centre = np.array([0.0, 0.0, 0.75 * height])
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, height]])
    vertices = np.concatenate([ends, rim + ends[1]]) - centre
    pairs = [(2 + k, 2 + (k + 1) % sides) for k in range(sides)]
    faces = [face for a, b in pairs for face in ((0, b, a), (1, a, b))]
    return shapes.Mesh(vertices, faces)


def tethered_body() -> Problem:
    """A rod of 1 kg that falls from the horizontal, tied to the ground by its end.

    The tether, of length 2, is horizontal too at first, and perpendicular to the rod. It is
    a `Distance`, which can push as well as pull.

    **Source:** Project Chrono, unit tests of joints against ADAMS, `Distance_Case02`.
    """
    body = bodies.RigidBody("body", 1.0, [0.04, 0.1, 0.1], [-1.0, 4.0, 3.0])
    tether = joints.Distance("tether", "ground", "body", [1.0, 2, 3], [2.0, 0, 0])
    return problem_of(Scene([body, tether], gravity=[0.0, 0.0, -9.80665]))
