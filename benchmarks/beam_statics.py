"""Statics and modes of beams with values that are exact or printed by other codes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy
from scipy.special import ellipeinc, ellipkinc

import enerjax as ej


@dataclass(frozen=True)
class Row:
    problem: str
    setting: str
    quantity: str
    value: float
    reference: float | None


def _tip(
    section: ej.Section,
    axis: Any,
    elements: int,
    force: Sequence[float],
    torque: float = 0.0,
    steps: int = 10,
) -> np.ndarray:
    """The displacement of the end of a cantilever that is loaded in steps."""
    beam = ej.bodies.Beam("beam", axis, section, elements)
    parts = [
        beam,
        ej.joints.Fixed("clamp", "ground", beam.start),
        ej.forces.ConstantForce("force", beam.end, list(force)),
    ]
    if len(force) == 2:
        parts.append(ej.forces.ConstantTorque("torque", beam.end, torque))
    scene = ej.Scene(parts)
    unloaded = scene.args.set("force", force=jnp.zeros(len(force)))
    if len(force) == 2:
        unloaded = unloaded.set("torque", torque=0.0)
    start = scene.start()
    found = ej.equilibrium(scene.system, start, scene.args, from_args=unloaded, steps=steps)
    place = lambda state: np.asarray(scene.position(state, beam.end))
    return place(found.state) - place(start)


def roll_up() -> Iterator[Row]:
    """An end moment closes a circle, whatever the number of elements."""
    section = ej.Section(EA=1e4, GA=1e4, EI=500.0, rhoA=1.0, rhoI=1.0)
    axis = [[0.0, 0.0], [10.0, 0.0]]
    for elements in (2, 8):
        moved = _tip(section, axis, elements, (0.0, 0.0), 100 * np.pi)
        for name, value, exact in zip("xy", moved, (-10.0, 0.0), strict=True):
            yield Row("roll-up", f"{elements} elements", name, value, exact)


def elastica() -> Iterator[Row]:
    """Without shear and stretch, in elliptic integrals. Shear adds up to 1.6e-7 here."""
    EI = 1e6
    section = ej.Section(EA=1e14, GA=1e14, EI=EI, rhoA=1.0, rhoI=1.0)
    for load in (1.0, 4.0, 16.0):
        d = scipy.optimize.brentq(
            lambda d, load: _first(d) - np.sqrt(load),
            np.pi / 4 + 1e-12,
            np.pi / 2 - 1e-12,
            args=(load,),
            xtol=1e-15,
        )
        angle = 2 * (np.pi / 4 - np.arccos(np.sqrt(_modulus(d))))
        part = ellipeinc(np.pi / 2, _modulus(d)) - ellipeinc(d, _modulus(d))
        exact = np.sqrt(2 * np.sin(angle) / load) - 1, 1 - 2 / np.sqrt(load) * part
        tips = [
            _tip(section, [[0.0, 0.0], [1.0, 0.0]], n, (0.0, load * EI)) for n in (64, 128)
        ]
        yield from _refined("elastica", f"P = {load:g} EI/L^2", tips, exact, "xy")


def _first(d: float) -> float:
    return ellipkinc(np.pi / 2, _modulus(d)) - ellipkinc(d, _modulus(d))


def _modulus(d: float) -> float:
    return (np.cos(np.pi / 4) / np.sin(d)) ** 2


def _refined(
    problem: str,
    setting: str,
    values: Sequence[np.ndarray],
    exact: Sequence[float],
    names: Sequence[str],
) -> Iterator[Row]:
    """The finer of two meshes, both extrapolated, and the order of their errors."""
    coarse, fine = map(np.asarray, values)
    both = (4 * fine - coarse) / 3
    for k, name in enumerate(names):
        yield Row(problem, setting, name, float(fine[k]), exact[k])
        yield Row(problem, setting, f"{name}, extrapolated", float(both[k]), exact[k])
    errors = [np.abs(x - np.asarray(exact)).max() for x in (coarse, fine)]
    yield Row(problem, setting, "order", float(np.log2(errors[0] / errors[1])), 2.0)


def thick_cantilever() -> Iterator[Row]:
    """K. Nachbagauer and others (2011); EXUDYN 1.13 gives these values for the same element
    (`ObjectBeamGeometricallyExact2D`), and the last ones are the limit."""
    height = 0.5
    section = ej.Section.rectangle(height, 0.1, E=2.07e11, nu=0.3, rho=1.0)
    printed = {
        1: (0.083234615650, 0.583551605547),
        4: (0.146411677562, 0.702928498132),
        16: (0.150685056643, 0.710091811634),
        64: (0.150953259426, 0.710538801439),
        1024: (0.1509716, 0.7105686),
    }
    for elements, values in printed.items():
        axis = [[0.0, 0.0], [2.0, 0.0]]
        moved = -_tip(section, axis, elements, (0.0, -5e8 * height**3), steps=4)
        names = ("shortening", "deflection")
        for name, value, reference in zip(names, moved, values, strict=True):
            setting = f"{elements} elements"
            yield Row("thick cantilever", setting, name, float(value), reference)


def coupled() -> Iterator[Row]:
    """A full matrix of stiffness; two codes agree on the reference."""
    stiffness = np.diag([1368.17e3, 88.56e3, 38.78e3, 16.96e3, 59.12e3, 141.47e3])
    stiffness[3, 4] = stiffness[4, 3] = 17.61e3
    stiffness[3, 5] = stiffness[5, 3] = -0.351e3
    stiffness[4, 5] = stiffness[5, 4] = -0.370e3
    section = ej.Section(stiffness=stiffness, rhoA=1.0, rhoI=1.0)
    axis, force = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]], (0.0, 0.0, 150.0)
    tips = [_tip(section, axis, n, force, steps=1) for n in (16, 32)]
    printed = (-9.02726627566299e-2, -6.47488486259036e-2, 1.22973648292371)
    yield from _refined("coupled", "16 and 32 elements", tips, printed, "xyz")


def princeton() -> Iterator[Row]:
    """A dead force at four angles to the section; the values are those of EXUDYN."""
    height, width = 12.3777e-3, 3.2024e-3
    second = height * width * (height**2 + width**2) / 12
    section = ej.Section.rectangle(
        height, width, E=71.7e9, nu=0.31, rho=1.0, shear_factor=1.0,
        torsion_constant=0.198 * second,
    )  # fmt: skip
    printed = {
        30: (0.0169316, 0.1179818),
        45: (0.0155488, 0.1565214),
        60: (0.0118996, 0.1817173),
        90: (0.0, 0.2003738),
    }
    axis = [[0.0, 0.0, 0.0], [0.508, 0.0, 0.0]]
    for degrees, values in printed.items():
        angle = np.radians(degrees)
        force = (0.0, -13.345 * np.cos(angle), 13.345 * np.sin(angle))
        tips = [_tip(section, axis, n, force) for n in (16, 32)]
        finer = (4 * tips[1] - tips[0]) / 3
        moved = dict(zip(("-y", "z"), (-finer[1], finer[2]), strict=True))
        for (name, value), reference in zip(moved.items(), values, strict=True):
            yield Row("princeton", f"{degrees} degrees", name, float(value), reference)


def timoshenko() -> Iterator[Row]:
    """The linear solution, of a load so small that the rest is round-off."""
    length, radius, E, G, alpha = 3.0, 0.25, 1e6, 1e4, 27 / 28
    area, part = np.pi * radius**2, 1e-6
    section = ej.Section(
        EA=E * area, GA=alpha * G * area, EI=E * np.pi * radius**4 / 4, rhoA=1.0, rhoI=1.0
    )
    axis = [[0.0, 0.0], [length, 0.0]]
    tips = [_tip(section, axis, n, (0.0, 15 * part), steps=1)[1:] / part for n in (16, 32)]
    yield from _refined("timoshenko", "16 and 32 elements", tips, (0.067770297,), "y")


def objectivity() -> Iterator[Row]:
    """The same beam and load, turned in space, and loaded in one step or in ten."""
    section = ej.Section(EA=1e4, GA=5e3, EI=[100.0, 60.0], GJ=50.0, rhoA=1.0, rhoI=1.0)
    rotation = scipy.spatial.transform.Rotation.from_rotvec([0.4, -2.0, 1.1]).as_matrix()
    axis, force = np.array([[0.0, 0, 0], [3.0, 0, 1.0]]), np.array([1.0, 5.0, -3.0])
    normal = np.array([0.0, 1.0, 0.0])
    found = []
    for turn, steps in ((np.eye(3), 10), (rotation, 10), (np.eye(3), 1)):
        beam = ej.bodies.Beam("beam", axis @ turn.T, section, 6, normal=turn @ normal)
        clamp = ej.joints.Fixed("clamp", "ground", beam.start)
        load = ej.forces.ConstantForce("force", beam.end, turn @ force)
        scene = ej.Scene([beam, clamp, load])
        unloaded = scene.args.set("force", force=jnp.zeros(3))
        start = scene.start()
        state = ej.equilibrium(
            scene.system, start, scene.args, from_args=unloaded, steps=steps
        ).state
        places = [np.asarray(scene.position(x, beam.end)) for x in (state, start)]
        found.append((places[0] - places[1]) @ turn)
    size = float(np.linalg.norm(found[0]))
    for setting, other in (("turned", found[1]), ("in one step", found[2])):
        change = float(np.abs(other - found[0]).max() / size)
        yield Row("objectivity", setting, "change of the tip, relative", change, 0.0)


def modes() -> Iterator[Row]:
    """Frequencies (rad/s) of a beam with thick sections, in closed form."""
    E, nu, rho, width = 1e9, 0.3, 7850.0, 0.4
    second = width**4 / 12
    section = ej.Section.rectangle(
        width, width, E=E, nu=nu, rho=rho, torsion_constant=2 * second * 0.8436
    )
    supports = {
        "bending": lambda beam: [
            ej.joints.Revolute("pin", "ground", beam.start),
            ej.joints.OnCurve("roller", "ground", beam.end, lambda x, numbers: x[1:]),
        ],
        "axial": lambda beam: [ej.joints.Fixed("clamp", "ground", beam.start)],
        "torsion": lambda beam: [
            ej.joints.Fixed("first", "ground", beam.start),
            ej.joints.Fixed("last", "ground", beam.end, [2.0, 0.0, 0.0]),
        ],
    }
    exact = {
        "bending": (95.63398088, 332.23451364),
        "axial": (280.32062513,),
        "torsion": (319.34980860,),
    }
    for kind, joints in supports.items():
        dimension = 3 if kind == "torsion" else 2
        axis = np.zeros((2, dimension))
        axis[1, 0] = 2.0
        values = []
        for elements in (32, 64):
            beam = ej.bodies.Beam("beam", axis, section, elements)
            scene = ej.Scene([beam, *joints(beam)])
            found = np.asarray(
                ej.modes(scene.system, scene.start(), scene.args).frequencies
            )
            nearest = lambda x, found=found: found[np.argmin(np.abs(found - x))]
            values.append(np.array([nearest(x) for x in exact[kind]]))
        names = [f"frequency {k + 1}" for k in range(len(exact[kind]))]
        yield from _refined("modes", kind, values, exact[kind], names)


STATICS: dict[str, Callable[[], Iterator[Row]]] = {
    "roll-up": roll_up,
    "elastica": elastica,
    "thick cantilever": thick_cantilever,
    "coupled": coupled,
    "princeton": princeton,
    "timoshenko": timoshenko,
    "objectivity": objectivity,
    "modes": modes,
}
