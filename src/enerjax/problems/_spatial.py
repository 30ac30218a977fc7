"""Bodies in space made of parts; gravity acts along -z."""

import jax.numpy as jnp
import numpy as np

from .._types import Real
from ..scenes import bodies, joints, Scene
from ._base import made, Problem


def steady_top(precession: Real = 10.0) -> Problem:
    """A cone that precesses steadily about its tip at 60 degrees from the vertical.

    Its height does not change: with the spin about its axis that belongs to the
    `precession` its rotation is `Rz(precession t) Rx(pi/3) Rz(spin t)`. In directors:
    mass centre, a distance of 0.075 from the tip, and body axes.

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
    )
    tip = joints.Spherical("tip", "ground", "top", [0.0, 0.0, 0.0])
    return made(Scene([top, tip], gravity=[0.0, 0.0, -gravity]))


def tethered_body() -> Problem:
    """A rod of 1 kg that falls from the horizontal, tied to the ground by its end.

    The tether, of length 2, starts horizontal too, at a right angle; as a `Distance` it
    carries pushes as well as pulls. In directors.

    **Source:** Project Chrono, unit tests of joints against ADAMS, `Distance_Case02`.
    """
    body = bodies.RigidBody("body", 1.0, [0.04, 0.1, 0.1], [-1.0, 4.0, 3.0])
    tether = joints.Distance("tether", "ground", "body", [1.0, 2, 3], [2.0, 0, 0])
    return made(Scene([body, tether], gravity=[0.0, 0.0, -9.80665]))
