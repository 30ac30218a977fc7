"""The rows of the constraints that belong to each part of a scene."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._types import Coordinates, Real
from ._functions import (
    constraint,
    driven,
    drives_at,
    inerters_at,
    internal,
    no_slip,
    redundancy,
)
from ._layout import Layout
from ._parameters import Parameters
from ._pose_view import evaluate_all, evaluate_slip, View
from ._user_functions import vector_of


def members(layout: Layout) -> list[tuple[str, ...]]:
    """The names of all joints, constraints, inerters and drives, in the order of their
    rows."""
    joined = [group.names for group in layout.joint_groups]
    joined += [(name,) for name, _ in layout.constraints]
    joined += [group.links.names for group in layout.inerter_groups]
    return joined + [group.names for group in layout.drive_groups]


def rows_of(layout: Layout, q: Coordinates, args: Parameters) -> dict[str, slice]:
    """The rows of each part. Internal rows of bodies are before those of drives."""

    def of_joints(q: Coordinates) -> list[Array]:
        view = View(layout, q)
        groups = zip(layout.joint_groups, args.tables["joints"], strict=True)
        found = evaluate_all(groups, view)
        own = [vector_of(name, fn, view, args) for name, fn in layout.constraints]
        found += [rows[None] for rows in own]
        return found + evaluate_all(inerters_at(layout, q, args), view)

    def of_drives(q: Coordinates) -> list[Array]:
        view = View(layout, q)
        return evaluate_all(drives_at(layout, jnp.zeros((), q.dtype), args), view)

    shapes = [x.shape for x in jax.eval_shape(of_joints, q)]
    num_joined = len(shapes)
    shapes += [x.shape for x in jax.eval_shape(of_drives, q)]
    places, first = {}, 0
    for k, (names, shape) in enumerate(zip(members(layout), shapes, strict=True)):
        if k == num_joined:
            first += layout.num_internal
        for name in names:
            places[name] = slice(first, first + shape[1])
            first += shape[1]
    return places


def slips_of(
    layout: Layout, q: Coordinates, args: Parameters, rows: dict[str, slice]
) -> dict[str, slice]:
    """The rows of the nonholonomic constraints of each part, which follow all others but
    the relations between coordinates."""
    at, found, first = View(layout, q), {}, _num_held(layout, q, args, rows)
    for k, group in layout.nonholonomic_groups:
        numbers = args.tables["joints"][k]
        slip = lambda q, group=group, numbers=numbers: evaluate_slip(
            group, View(layout, q), at, numbers
        )
        width = jax.eval_shape(slip, q).shape[1]
        for name in group.names:
            found[name] = slice(first, first + width)
            first += width
    return found


def check_reacting(
    joint: str, rows: dict[str, slice], ends: dict[str, tuple[str, str]]
) -> None:
    """Raises an error unless this is a joint or drive between two bodies."""
    if joint in rows and joint not in ends:
        raise ValueError(
            f"'{joint}' is a constraint of your own, which connects no particular bodies. "
            f"Its multipliers are `scene.multipliers(sol, '{joint}')`, and its force is "
            "`-B^T lambda`."
        )
    if joint not in rows:
        joints = [name for name in rows if name in ends]
        raise ValueError(f"There is no joint '{joint}'; there are {joints}.")


def row_names(
    layout: Layout,
    q: Coordinates,
    args: Parameters,
    rows: dict[str, slice],
    slips: dict[str, slice],
) -> list[str]:
    """The name of each row of the constraints, in the order of the multipliers."""
    outside = jax.eval_shape(lambda q: redundancy(layout, q, args), q).size
    held = _num_held(layout, q, args, rows)
    last = max([held, *(place.stop for place in slips.values())])
    names = [str(k) for k in range(last + outside)]
    named = [*rows.items(), *((f"{name}.slip", place) for name, place in slips.items())]
    for name, place in named:
        several = place.stop - place.start > 1
        for k in range(place.start, place.stop):
            names[k] = f"{name}[{k - place.start}]" if several else name
    return names


def _num_held(
    layout: Layout, q: Coordinates, args: Parameters, rows: dict[str, slice]
) -> int:
    """The number of rows of joints, of drives, and inside of bodies."""
    inside = 0
    if layout.has_constraints:
        inside = jax.eval_shape(lambda q: constraint(layout, q, args), q).size
    inside += layout.num_internal
    return max([inside, *(place.stop for place in rows.values())])


def first_dependent(
    layout: Layout, q: Coordinates, t: Real, args: Parameters, places: dict[str, slice]
) -> str | None:
    """The first joint with a row that depends on those before it."""
    start = jnp.asarray(t, q.dtype)
    gradients = []
    if layout.has_constraints:
        gradients += [*jax.jacfwd(lambda x: constraint(layout, x, args))(q)]
    gradients += [*jax.jacfwd(lambda x: internal(layout, x))(q)]
    if layout.drives:
        gradients += [*jax.jacfwd(lambda x: driven(layout, x, start, args))(q)]
    of_parts = {k for place in places.values() for k in range(place.start, place.stop)}
    # The internal rows of bodies count first.
    rows = [row for k, row in enumerate(gradients) if k not in of_parts]
    rows += [*jax.jacfwd(lambda x: redundancy(layout, x, args))(q)]
    if layout.nonholonomic_groups:
        rows += [*no_slip(layout, q, args)]
    for name, place in places.items():
        rows += gradients[place]
        if np.linalg.matrix_rank(np.array(rows)) < len(rows):
            return name
    return None
