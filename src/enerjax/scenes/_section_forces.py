"""The strains, forces, moments and energies of beams along runs."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import compiled
from .._system import State
from ._beam_functions import resultants, strains
from ._frames import Numbers
from ._layout import Beams, Layout
from ._parameters import Parameters
from ._pose_view import View
from ._reactions import each


class SectionForces(NamedTuple):
    """The strains of a beam and the forces in it, in the middle of each element.

    The leading axis of all but `arc_length` is that of the times; one state has none.
    Components are along the axes of the section, of which axis 1 is along the beam.

    - `arc_length`: of the middles of the elements, from the start, shape `(elements,)`.
    - `force`: what the part of the beam with the greater arc length exerts on the other,
      shape `(times, elements, d)`: the normal force, and shear forces along axis 2, and in
      space axis 3 (force).
    - `moment`: of the same part; in the plane the bending moment, shape `(times, elements,
      1)`; in space torsion, and bending about axes 2 and 3, shape `(times, elements, 3)`.
    - `strain`: of stretch and shear, shape of `force` (of no dimension).
    - `curvature`: of torsion and bending, shape of `moment` (per length). Both strains are
      differences from those without stress.
    - `energies`: of the whole beam by `"stretch"`, `"shear"`, `"torsion"` (in space) and
      `"bending"`, shape `(times,)`. The work of a coupled stiffness is shared out by
      strains.
    """

    arc_length: Float[Array, " elements"]
    force: Array
    moment: Array
    strain: Array
    curvature: Array
    energies: dict[str, Array]


def section_forces(layout: Layout, ys: State, beam: str, args: Parameters) -> SectionForces:
    beams, numbers = _beam(layout, beam, args)
    found, forces = _along(layout, beam, ys.q, args)
    lengths, split = numbers["length"][0], beams.law.num_forces
    works = 0.5 * jnp.einsum("e,...es->...s", lengths, found * forces)
    energies = {
        name: jnp.sum(works[..., np.array(own)], axis=-1)
        for name, own in beams.law.components.items()
    }
    return SectionForces(
        jnp.cumsum(lengths) - 0.5 * lengths,
        forces[..., :split],
        forces[..., split:],
        found[..., :split],
        found[..., split:],
        energies,
    )


@compiled
def _along(layout: Layout, beam: str, q: Array, args: Parameters) -> tuple[Array, Array]:
    """The strains of all elements in all states, and their forces and moments."""
    beams, numbers = _beam(layout, beam, args)

    def of_state(q: Array) -> tuple[Array, Array]:
        found = strains(beams, View(layout, q), numbers)
        return found[0], resultants(beams, found, numbers)[0]

    return each(of_state, q)


def centreline(layout: Layout, ys: State, beam: str) -> Array:
    rows = _of_name(layout, beam)[0].sections[0]
    return each(lambda q: View(layout, q).origins[rows], ys.q)


def _beam(layout: Layout, name: str, args: Parameters) -> tuple[Beams, Numbers]:
    """One beam, and its numbers as tables with one row."""
    beams, group, row = _of_name(layout, name)
    table = args.tables["beams"][group]
    return beams, {key: x[row : row + 1] for key, x in table.items()}


def _of_name(layout: Layout, name: str) -> tuple[Beams, int, int]:
    places = layout.places["beams"]
    if name not in places:
        raise ValueError(f"There is no beam '{name}'; there are {[*places]}.")
    group, row = places[name]
    beams = layout.beam_groups[group]
    only = slice(row, row + 1)
    one = Beams(beams.law, (name,), beams.sections[only], beams.weights[only])
    return one, group, row
