"""The potential energy of a scene, and its strains."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._programs import at_places
from .._system import AbstractStrainEnergy
from .._types import Coordinates, Scalar
from ._beam_functions import (
    elastic_energy,
    energy_of_line_loads,
    numbers_of_bodies,
    strains,
    stresses,
)
from ._frames import Numbers
from ._laws import AbstractForceLaw, AbstractSpringLaw, Elastic
from ._layout import Layout, Links
from ._measures import AbstractTurn
from ._parameters import Parameters
from ._pose_view import evaluate_all, View
from ._user_functions import ask


Law = TypeVar("Law", bound=AbstractSpringLaw)


class PotentialOfScene(AbstractStrainEnergy):
    """The potential of a scene, whose `args` are `Parameters`.

    Its strains are those of linear springs, followed by those of beams.
    """

    layout: Layout = eqx.field(static=True)

    def __call__(self, q, args=None):
        return _energy(self.layout, q, args)

    def strains(self, q, args=None):
        view = View(self.layout, q)
        springs = _springs(self.layout, args, Elastic)
        measured = evaluate_all(
            [(group._replace(law=law.measure), own) for group, law, own in springs], view
        )
        of_springs = [
            jax.vmap(law.strain)(values, numbers)
            for (_, law, numbers), values in zip(springs, measured, strict=True)
        ]
        groups = zip(self.layout.beam_groups, args.tables["beams"], strict=True)
        of_beams = [strains(beams, view, numbers) for beams, numbers in groups]
        return (*of_springs, *of_beams)

    def stresses(self, strains, args=None):
        tables = [numbers for _, _, numbers in _springs(self.layout, args, Elastic)]
        count = len(tables)
        of_springs = [
            numbers["stiffness"] * own
            for numbers, own in zip(tables, strains[:count], strict=True)
        ]
        beams = zip(self.layout.beam_groups, args.tables["beams"], strict=True)
        of_beams = [
            stresses(group, own, numbers)
            for (group, numbers), own in zip(beams, strains[count:], strict=True)
        ]
        return (*of_springs, *of_beams)

    def angles(self, q, args=None):
        in_space = [
            (group._replace(law=law.measure), numbers)
            for group, law, numbers in _springs(self.layout, args, AbstractSpringLaw)
            if isinstance(law.measure, AbstractTurn)
        ]
        found = evaluate_all(in_space, View(self.layout, q))
        acting = [
            jnp.where(_acts(numbers), angles, 0)
            for (_, numbers), angles in zip(in_space, found, strict=True)
        ]
        return jnp.concatenate([q[:0], *acting])


def _acts(numbers: Numbers) -> Bool[Array, " parts"]:
    """Which springs have a stiffness; without one their energy is smooth."""
    names = [x for x in ("stiffness", "quadratic", "cubic") if x in numbers]
    return jnp.any(jnp.stack([numbers[x] != 0 for x in names]), axis=0)


def _springs(
    layout: Layout, args: Parameters, kind: type[Law]
) -> list[tuple[Links, Law, Numbers]]:
    """All groups of springs of a kind, with their laws and numbers."""
    groups = zip(layout.force_groups, args.tables["forces"], strict=True)
    return [
        (group, group.law, numbers)
        for group, numbers in groups
        if isinstance(group.law, kind)
    ]


def _energy(layout: Layout, q: Coordinates, args: Parameters) -> Scalar:
    view = View(layout, q)
    energy = jnp.zeros((), q.dtype)
    if layout.has_gravity:
        energy = energy - _weight(view, args)
    groups = zip(layout.force_groups, args.tables["forces"], strict=True)
    elastic = [x for x in groups if not isinstance(x[0].law, AbstractForceLaw)]
    for values in evaluate_all(elastic, view):
        energy = energy + jnp.sum(values)
    if layout.beams:
        energy = energy + elastic_energy(layout, view, args)
    if layout.line_loads:
        energy = energy + energy_of_line_loads(layout, view, args)
    for name, function in layout.potentials:
        energy = energy + ask(name, function, view, args)
    return energy


def _weight(view: View, args: Parameters) -> Scalar:
    """The work of gravity on all bodies, from the origin to their positions."""
    work = jnp.zeros((), view.q.dtype)
    for group, numbers in numbers_of_bodies(view.layout, args):
        origins = jax.vmap(group.kind.origin)(at_places(view.q, group.q))
        forces = numbers["mass"][:, None] * args["gravity"][None, :]
        work = work + jnp.sum(forces * origins)
    return work
