"""The structure of a scene as tables of integers, which are known before tracing."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ._body_coordinates import AbstractBodyCoordinates
from ._frames import GROUND
from ._laws import AbstractForceLaw, AbstractNonholonomicLaw
from ._measures import AbstractLaw
from ._strains import AbstractStrains


class Link(NamedTuple):
    """A joint, drive or force: its law, and the indices of its bodies (0 is the ground)."""

    name: str
    law: AbstractLaw
    a: int
    b: int


class Bodies(NamedTuple):
    """All bodies of a kind, with a row of indices of coordinates and velocities each."""

    kind: AbstractBodyCoordinates
    names: tuple[str, ...]
    q: np.ndarray
    v: np.ndarray


class Links(NamedTuple):
    """All joints, drives or forces with the same law."""

    law: AbstractLaw
    names: tuple[str, ...]
    a: np.ndarray
    b: np.ndarray


class BeamLink(NamedTuple):
    """A beam: the law of its strains, the rows of its sections in a table of frames, and
    the parts of its mass that are in them."""

    name: str
    law: AbstractStrains
    sections: tuple[int, ...]
    weights: tuple[float, ...]


class Beams(NamedTuple):
    """All beams with the same law and as many elements; tables have a row for each."""

    law: AbstractStrains
    names: tuple[str, ...]
    sections: np.ndarray
    weights: np.ndarray


class LineLoadLink(NamedTuple):
    """A load on a beam, with the rows of the sections of the beam."""

    name: str
    sections: tuple[int, ...]


class LineLoads(NamedTuple):
    """All loads on beams of as many sections; `sections` has a row for each."""

    names: tuple[str, ...]
    sections: np.ndarray


class Inerters(NamedTuple):
    """All inerters with the same law, and the index of the coordinate of each."""

    links: Links
    q: np.ndarray
    v: np.ndarray


@dataclass(frozen=True)
class Layout:
    """The structure of a scene, without its numbers; compared by value.

    Coordinates and velocities are ordered like the bodies among the parts; those of
    inerters follow, one each. The frames of bodies are numbered kind by kind, starting from
    1, so that a table of all frames is a concatenation.
    """

    dimension: int
    bodies: tuple[tuple[str, AbstractBodyCoordinates], ...]
    joints: tuple[Link, ...]
    forces: tuple[Link, ...]
    constraints: tuple[tuple[str, Callable], ...]
    potentials: tuple[tuple[str, Callable], ...]
    has_gravity: bool
    drives: tuple[Link, ...] = ()
    inerters: tuple[Link, ...] = ()
    contacts: tuple[Link, ...] = ()
    beams: tuple[BeamLink, ...] = ()
    line_loads: tuple[LineLoadLink, ...] = ()

    @cached_property
    def body_groups(self) -> tuple[Bodies, ...]:
        sizes = [(k.num_coordinates, k.num_velocities) for _, k in self.bodies]
        starts = np.concatenate([np.zeros((1, 2), int), np.cumsum(sizes, axis=0)])
        position = {name: k for k, (name, _) in enumerate(self.bodies)}
        groups = []
        for kind, members in _grouped(self.bodies, lambda body: body[1]):
            names = tuple(name for name, _ in members)
            first = starts[[position[name] for name in names]]
            q = first[:, :1] + np.arange(kind.num_coordinates)
            v = first[:, 1:] + np.arange(kind.num_velocities)
            groups.append(Bodies(kind, names, q, v))
        return tuple(groups)

    @cached_property
    def numbers_of_bodies(self) -> dict[str, int]:
        """The row of each body in a table of frames."""
        return numbers_of(self.bodies)

    @cached_property
    def turning(self) -> np.ndarray:
        """Which rows of a table of frames belong to bodies with an orientation."""
        flags = [[group.kind.turns] * len(group.names) for group in self.body_groups]
        return np.array([False, *sum(flags, [])])

    @cached_property
    def joint_groups(self) -> tuple[Links, ...]:
        return _links(self.joints)

    @cached_property
    def force_groups(self) -> tuple[Links, ...]:
        return _links(self.forces)

    @cached_property
    def drive_groups(self) -> tuple[Links, ...]:
        return _links(self.drives)

    @cached_property
    def contact_groups(self) -> tuple[Links, ...]:
        return _links(self.contacts)

    @cached_property
    def inerter_groups(self) -> tuple[Inerters, ...]:
        place = {link.name: k for k, link in enumerate(self.inerters)}
        q = self.num_coordinates - len(place)
        v = self.num_velocities - len(place)
        groups = []
        for links in _links(self.inerters):
            own = np.array([place[name] for name in links.names])
            groups.append(Inerters(links, q + own, v + own))
        return tuple(groups)

    @cached_property
    def beam_groups(self) -> tuple[Beams, ...]:
        members = _grouped(self.beams, lambda beam: (beam.law, len(beam.sections)))
        return tuple(
            Beams(
                law,
                tuple(beam.name for beam in beams),
                np.array([beam.sections for beam in beams]),
                np.array([beam.weights for beam in beams]),
            )
            for (law, _), beams in members
        )

    @cached_property
    def line_load_groups(self) -> tuple[LineLoads, ...]:
        return tuple(
            LineLoads(
                tuple(load.name for load in loads),
                np.array([load.sections for load in loads]),
            )
            for _, loads in _grouped(self.line_loads, lambda load: len(load.sections))
        )

    @property
    def has_constraints(self) -> bool:
        return bool(self.joints or self.constraints or self.inerters)

    @property
    def nonholonomic_groups(self) -> tuple[tuple[int, Links], ...]:
        """The groups of joints that forbid bodies to slip, and their numbers."""
        groups = enumerate(self.joint_groups)
        return tuple(x for x in groups if isinstance(x[1].law, AbstractNonholonomicLaw))

    @property
    def rigid_bodies(self) -> np.ndarray | None:
        """The coordinates of the bodies with directors, in the plane of those with an
        angle; `None` if there are none."""
        rigid = lambda kind: kind.turns and kind.num_redundant == 0
        groups = [group.q for group in self.body_groups if rigid(group.kind)]
        return np.concatenate(groups) if groups else None

    @property
    def num_internal(self) -> int:
        """The number of constraints between directors."""
        return sum(kind.num_internal for _, kind in self.bodies)

    @property
    def has_pushes(self) -> bool:
        return any(group is not None for group in self.push_groups)

    @cached_property
    def push_groups(self) -> tuple[Links | None, ...]:
        """The force groups with the laws of their forces; `None` for those with a potential
        alone."""

        def pushing(group: Links) -> Links | None:
            if isinstance(group.law, AbstractForceLaw):
                return group
            damper = getattr(group.law, "damper", None)
            return None if damper is None else group._replace(law=damper)

        return tuple(pushing(group) for group in self.force_groups)

    @cached_property
    def places(self) -> dict[str, dict[str, tuple[int, int]]]:
        """The group and the row of every part, for each section of the parameters."""
        sections = dict(
            bodies=self.body_groups,
            joints=self.joint_groups,
            forces=self.force_groups,
            drives=self.drive_groups,
            inerters=[group.links for group in self.inerter_groups],
            contacts=self.contact_groups,
            beams=self.beam_groups,
            line_loads=self.line_load_groups,
        )
        return {
            section: {
                name: (number, row)
                for number, group in enumerate(groups)
                for row, name in enumerate(group.names)
            }
            for section, groups in sections.items()
        }

    @property
    def num_coordinates(self) -> int:
        own = sum(kind.num_coordinates for _, kind in self.bodies)
        return own + len(self.inerters)

    @property
    def num_velocities(self) -> int:
        own = sum(kind.num_velocities for _, kind in self.bodies)
        return own + len(self.inerters)


def numbers_of(bodies: Iterable[tuple[str, AbstractBodyCoordinates]]) -> dict[str, int]:
    """The row of each body in a table of frames: first the ground, then kind by kind."""
    groups = _grouped(bodies, lambda body: body[1])
    names = [name for _, members in groups for name, _ in members]
    return {name: k for k, name in enumerate([GROUND, *names])}


def _links(links: tuple[Link, ...]) -> tuple[Links, ...]:
    return tuple(
        Links(
            law,
            tuple(link.name for link in members),
            np.array([link.a for link in members]),
            np.array([link.b for link in members]),
        )
        for law, members in _grouped(links, lambda link: link.law)
    )


def _grouped(items: Iterable[Any], key: Callable[[Any], Hashable]) -> list[tuple]:
    """The items with equal keys together, in the order in which the keys first appear."""
    groups: dict[Any, list] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return list(groups.items())
