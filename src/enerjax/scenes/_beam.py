"""Beams, which users find in `bodies`."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from .._programs import compiled_for_once, is_known, module_of
from .._types import Real, Vector
from ._arguments import velocities
from ._beam_geometry import along_curve, places_of, Sections, straight, weights_of
from ._body import AbstractBody
from ._body_coordinates import AbstractBodyCoordinates, DirectorBodies, PlanarBodies
from ._frames import Frame, Numbers
from ._strains import AbstractStrains, PlanarStrains, SpatialStrains
from .section import Section
from .shapes import AbstractShape, as_shapes, Box, Capsule, Shape


# The radius of beams in pictures, over their length, if the section has no outline.
_THICKNESS = 0.008
_COLOR = "steelblue"
# Arc lengths that differ by less, as parts of the whole, are the same.
_SAME = 1e-9


class BeamSection(AbstractBody):
    """A cross-section at the end of an element of a beam: a body of the scene."""

    numbers: Numbers
    q: Any
    v: Any
    prescribed: tuple[bool, ...]
    shapes: tuple[AbstractShape, ...] | None

    @property
    def kind(self) -> AbstractBodyCoordinates:
        if np.shape(self.q) == (3,):
            return PlanarBodies(is_section=True)
        return DirectorBodies(is_section=True)


class Beam(eqx.Module):
    """A flexible beam in the plane or in space, which can move and deform by any amount.

        arm = ej.bodies.Beam("arm", [[0, 0, 0], [1, 0, 0]], section, elements=16)
        clamp = ej.joints.Fixed("clamp", "ground", arm.start)
        load = ej.forces.ConstantForce("load", arm.end, [0, 0, -5.0])

    It is geometrically exact: it can be stretched, sheared, bent and twisted, with the
    stiffness of its `section` for each. It consists of elements with two sections each,
    which stay plane, and its error is of second order in the length of the elements. The
    mass is in the sections. The beam has no stress in the start pose.

    Its sections are bodies of the scene, with names for joints, forces, drives and results:
    `arm.start`, `arm.end`, `arm.node(3)` and `arm.at(0.25)` are the strings `"arm:start"`,
    `"arm:end"`, `"arm:3"` and so on. The origin of the frame of a section is on the axis of
    the beam, and its axis 1 is along it.

    **Arguments:**

    - `name`: a string, unique in the scene.
    - `axis`: two points, shape `(2, d)`, of a straight beam, or a function `axis(u)` of a
      number from 0 to 1, written with `jax.numpy`, that returns the points of a curved one
      (length). Points have two or three entries.
    - `section`: its stiffness and inertia, an `ej.Section`.
    - `elements`: their number, or the arc lengths of all sections as fractions of the
      whole, such as `[0, 0.25, 0.5, 1]`. With a number, sections are at equal arc lengths.
    - `normal`: in space, the direction of axis 2 of the section at the start; its part
      along the beam is removed. By default axis 2 is horizontal and axis 3 upwards, if z is
      upwards; where the beam starts vertically, axis 2 is along y.
    - `twist`: in space, the angle by which sections are turned about the axis without
      stress, from the start to the end of the beam (radians); or a function of the arc
      length as a fraction of the whole. Without it, sections turn about the axis as little
      as possible.
    - `velocity`, `angular_velocity`: of a rigid motion at the start, about the middle of
      the mass (length per time, angle per time).
    - `shape`: what pictures show of each section; by default its outline, or a rod.

    `args["beams"][name]` contains the numbers of the section, the `length` of each element,
    and its strains without stress, `reference`, shape `(elements, 3)`, in space `(elements,
    6)`.

    `EnergyPreserving` keeps energy, momentum and angular momentum to round-off, and
    `EnergyMomentumDecaying` keeps the momenta while it damps the strains. In space, schemes
    that refuse flat bodies need a section with three moments of inertia.

    **Raises:** `ValueError` for sections that coincide, elements that would turn by more
    than a right angle, a curve that stands still, and impossible numbers.
    """

    name: str
    nodes: tuple[BeamSection, ...]
    law: AbstractStrains
    numbers: Numbers
    places: tuple[float, ...]

    def __init__(
        self,
        name: str,
        axis: Vector | Sequence[Vector] | Callable[[Any], Any],
        section: Section,
        elements: Any = 16,
        *,
        normal: Vector | None = None,
        twist: Real | Callable[[float], Real] | None = None,
        velocity: Vector | None = None,
        angular_velocity: Any = None,
        shape: Shape | None = None,
    ):
        if not isinstance(section, Section):
            raise TypeError(
                f"`section` of '{name}' must be an `ej.Section`, got {section!r}."
            )
        places = places_of(name, elements)
        if callable(axis):
            sections = along_curve(name, axis, places, normal, twist)
        else:
            sections = straight(name, axis, places, normal, twist)
        dimension = sections.origins.shape[1]
        laws = {2: PlanarStrains, 3: SpatialStrains}
        self.name, self.law = name, laws[dimension](section.is_coupled)
        self.places = tuple(float(x) for x in sections.places)
        numbers = section.in_dimension(name, dimension) | dict(
            length=sections.lengths, reference=_strains(self.law, sections)
        )
        self.numbers = {key: module_of(x).asarray(x) * 1.0 for key, x in numbers.items()}
        shapes = as_shapes(f"'{name}'", shape)
        q = _coordinates(sections)
        all_shapes = (
            [shapes] * len(q) if shapes is not None else _outlines(section, sections)
        )
        v, flags = _velocities(name, sections, velocity, angular_velocity)
        self.nodes = tuple(
            BeamSection(self.node(k), {}, q[k], v[k], flags, all_shapes[k])
            for k in range(len(q))
        )

    @property
    def start(self) -> str:
        """The name of the section at the start."""
        return self.node(0)

    @property
    def end(self) -> str:
        """The name of the section at the end."""
        return self.node(-1)

    def node(self, number: int) -> str:
        """The name of a section, counted from 0 at the start, or from -1 at the end."""
        last = len(self.places) - 1
        if not -last - 1 <= number <= last:
            raise ValueError(
                f"'{self.name}' has the sections 0 to {last}, got number {number}."
            )
        number = number % (last + 1)
        words = {0: "start", last: "end"}
        return f"{self.name}:{words.get(number, number)}"

    def at(self, arc_length: float) -> str:
        """The name of the section at an arc length from the start.

        **Raises:** `ValueError` beyond the ends, and where there is no section: `elements`
        places them.
        """
        lengths = self.numbers["length"]
        if not is_known((arc_length, lengths)):
            raise ValueError(
                f"`at` of '{self.name}' needs known lengths: which section it is, is part "
                "of the program. Use `node`."
            )
        total = float(np.sum(lengths))
        place = float(arc_length) / total
        if not -_SAME <= place <= 1 + _SAME:
            raise ValueError(
                f"The arc length {arc_length} is not on '{self.name}', whose length is "
                f"{total:.6g}."
            )
        nearest = int(np.argmin(np.abs(np.array(self.places) - place)))
        if abs(self.places[nearest] - place) > _SAME:
            raise ValueError(
                f"'{self.name}' has no section at the arc length {arc_length}; the nearest "
                f"is at {self.places[nearest] * total:.6g}. Choose another number of "
                f"`elements`, or pass the places of all sections, with {place:.6g} among "
                "them."
            )
        return self.node(nearest)


def _strains(law: AbstractStrains, sections: Sections) -> Any:
    """The strains of all elements in the reference."""
    frames = Frame(sections.origins, sections.axes, sections.angles)
    a, b = (
        jax.tree.map(lambda x, part=part: x[part], frames)
        for part in (slice(None, -1), slice(1, None))
    )
    strains = _strains_of(law, a, b, sections.lengths)
    return np.asarray(strains) if is_known(strains) else strains


@compiled_for_once
def _strains_of(law: AbstractStrains, a: Frame, b: Frame, lengths: Array) -> Array:
    return jax.vmap(law)(a, b, dict(length=lengths))


def _coordinates(sections: Sections) -> Any:
    """The coordinates of all sections, one row each."""
    turned = sections.axes.reshape(len(sections.places), -1)
    if sections.angles is not None:
        turned = sections.angles[:, None]
    return module_of(turned, sections.origins).concatenate(
        [sections.origins, turned], axis=1
    )


def _velocities(
    name: str, sections: Sections, velocity: Any, angular_velocity: Any
) -> tuple[Any, tuple[bool, ...]]:
    """The velocities of all sections in a rigid motion, and which are prescribed."""
    count, dimension = sections.origins.shape
    spin_shape = () if dimension == 2 else (3,)
    (v, flags) = velocities(
        f"'{name}'", (velocity, (dimension,)), (angular_velocity, spin_shape)
    )
    xp = module_of(v, sections)
    middle = weights_of(sections.places) @ sections.origins
    arms = sections.origins - middle
    if dimension == 2:
        moved = v[:2] + v[2] * xp.stack([-arms[:, 1], arms[:, 0]], axis=1)
        turned = xp.broadcast_to(v[2], (count, 1))
    else:
        moved = v[:3] + xp.cross(v[3:], arms)
        turned = xp.cross(v[3:], sections.axes).reshape(count, 9)
    # A rotation moves all sections, and without one the velocity is that of all.
    place = (any(flags),) * dimension
    turn = (flags[-1],) * turned.shape[1]
    return xp.concatenate([moved, turned], axis=1), (*place, *turn)


def _outlines(section: Section, sections: Sections) -> list[tuple[AbstractShape, ...]]:
    """What pictures show of all sections: pieces up to the middles of the elements."""
    lengths, dimension = sections.lengths, sections.origins.shape[1]
    xp = module_of(lengths)
    before = xp.concatenate([0 * lengths[:1], 0.5 * lengths])
    after = xp.concatenate([0.5 * lengths, 0 * lengths[:1]])
    kind, sizes = section.outline or ("circle", _THICKNESS * xp.sum(lengths))
    along = np.eye(dimension)[0]
    if kind == "rectangle" and is_known((lengths, sizes)):
        sides = [float(x) for x in sizes][: dimension - 1]
        return [
            (Box([a + b, *sides], 0.5 * (b - a) * along, color=_COLOR),)
            for a, b in zip(before, after, strict=True)
        ]
    radius = sizes if kind == "circle" else 0.5 * sizes[0]
    return [
        (Capsule.between(-a * along, b * along, radius, color=_COLOR),)
        for a, b in zip(before, after, strict=True)
    ]
