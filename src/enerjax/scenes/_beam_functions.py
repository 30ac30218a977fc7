"""Strains, energies and masses of all beams of a scene."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ._frames import Numbers
from ._layout import Beams, Bodies, Layout
from ._parameters import Parameters
from ._pose_view import View


def numbers_of_bodies(layout: Layout, args: Parameters) -> list[tuple[Bodies, Numbers]]:
    """All groups of bodies with their mass and inertia; those of sections follow from the
    beams."""
    groups = zip(layout.body_groups, args.tables["bodies"], strict=True)
    return [
        (group, _masses(layout, group, args) if group.kind.is_section else numbers)
        for group, numbers in groups
    ]


def _masses(layout: Layout, group: Bodies, args: Parameters) -> Numbers:
    """The mass and inertia of all sections, in the order of their group."""
    first = layout.numbers_of_bodies[group.names[0]]
    rows, masses, inertias = [], [], []
    for beams, numbers in zip(layout.beam_groups, args.tables["beams"], strict=True):
        lengths, rhoI = numbers["length"], numbers["rhoI"]
        # The moment of inertia of a rod is that of its mass, so the places of the masses
        # count; those of the moments of sections do not.
        own = beams.weights * jnp.sum(lengths, axis=1, keepdims=True)
        halves = 0.5 * (
            jnp.pad(lengths, ((0, 0), (0, 1))) + jnp.pad(lengths, ((0, 0), (1, 0)))
        )
        rows.append(beams.sections.ravel() - first)
        masses.append((own * numbers["rhoA"][:, None]).ravel())
        products = jax.vmap(jnp.multiply.outer)(halves, rhoI)
        inertias.append(products.reshape(-1, *rhoI.shape[1:]))
    order = np.argsort(np.concatenate(rows))
    ordered = lambda parts: (
        parts[0] if len(parts) == 1 else jnp.concatenate(parts)[order]
    )  # fmt: skip
    return dict(mass=ordered(masses), inertia=ordered(inertias))


def strains(
    beams: Beams, view: View, numbers: Numbers
) -> Float[Array, "beams elements strains"]:
    """The strains of all elements, less those of the reference."""
    count, ends = beams.sections.shape
    a = view.frames(beams.sections[:, :-1].ravel(), beams.law.reads)
    b = view.frames(beams.sections[:, 1:].ravel(), beams.law.reads)
    lengths = numbers["length"].ravel()
    found = jax.vmap(lambda a, b, length: beams.law(a, b, dict(length=length)))(
        a, b, lengths
    )
    return found.reshape(count, ends - 1, -1) - numbers["reference"]


def resultants(beams: Beams, strains: Array, numbers: Numbers) -> Array:
    """The forces and moments of these strains, in the axes of the sections."""
    return jax.vmap(beams.law.resultants)(strains, numbers)


def stresses(
    beams: Beams, strains: Array, numbers: Numbers
) -> Float[Array, "beams elements strains"]:
    """The resultants of elements times their lengths: the derivatives of the energy."""
    return numbers["length"][:, :, None] * resultants(beams, strains, numbers)


def elastic_energy(layout: Layout, view: View, args: Parameters) -> Scalar:
    """The energy of the strains of all beams."""
    energy = jnp.zeros((), view.q.dtype)
    for beams, numbers in zip(layout.beam_groups, args.tables["beams"], strict=True):
        own = strains(beams, view, numbers)
        density = jnp.sum(resultants(beams, own, numbers) * own, axis=2)
        energy = energy + 0.5 * jnp.sum(numbers["length"] * density)
    return energy


def energy_of_line_loads(layout: Layout, view: View, args: Parameters) -> Scalar:
    """Minus the work of constant forces per length, from the origin."""
    energy = jnp.zeros((), view.q.dtype)
    groups = zip(layout.line_load_groups, args.tables["line_loads"], strict=True)
    for loads, numbers in groups:
        places = view.frames(loads.sections.ravel(), ("origin",)).origin
        forces = jax.vmap(lambda w, f: w[:, None] * f[None])(
            numbers["length"], numbers["force"]
        )
        energy = energy - jnp.sum(forces.reshape(places.shape) * places)
    return energy
