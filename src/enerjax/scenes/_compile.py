"""Compiles a list of parts to a layout and its parameters."""

from collections.abc import Container, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._programs import compiled_for_once, is_known, module_of
from .._types import Coordinates, Velocities
from ._arguments import number
from ._beam_geometry import weights_of
from ._ends import Ends, Hinge, Hinges
from ._frames import Frame, GROUND, Numbers
from ._inerters import AbstractInerter
from ._law_checks import resolved_part
from ._laws import Flywheel, Gap
from ._layout import BeamLink, Layout, LineLoadLink, Link, numbers_of
from ._parameters import Parameters
from ._pose_view import evaluate, lift, View
from .bodies import AbstractBody, Beam
from .contacts import AbstractContact
from .drives import AbstractDrive
from .forces import AbstractForce, LineLoad, Potential
from .joints import AbstractJoint, Constraint


# The kinds of parts that connect two bodies. Joints are first, because other parts depend
# on the axes that joints keep common to two bodies.
LINKS = (AbstractJoint, AbstractForce, AbstractDrive, AbstractInerter, AbstractContact)


def sort_parts(parts: Sequence[Any]) -> dict[type, list[Any]]:
    """The parts by their class, after checks of their names and dimensions."""
    kinds = (
        AbstractBody, AbstractJoint, AbstractForce, AbstractDrive, AbstractInerter,
        AbstractContact, Constraint, Potential, Beam, LineLoad,
    )  # fmt: skip
    found: dict[type, list[Any]] = {kind: [] for kind in kinds}
    if isinstance(parts, kinds):
        raise TypeError(
            f"A scene is made of a list of parts: write `Scene([{parts.name}])`."
        )
    names = set()
    for part in parts:
        kind = next((kind for kind in kinds if isinstance(part, kind)), None)
        if kind is None:
            raise TypeError(
                "A scene is made of bodies, joints, forces, drives and contacts, got "
                f"{part!r}."
            )
        if not isinstance(part.name, str):
            raise TypeError(f"A name must be a string, got {part.name!r}.")
        if part.name == GROUND:
            raise ValueError(
                f"The name '{GROUND}' is reserved for the fixed frame of every scene: "
                f"choose another for your {type(part).__name__}."
            )
        if part.name in names:
            raise ValueError(f"There are two parts with the name '{part.name}'.")
        names.add(part.name)
        found[kind].append(part)
        if isinstance(part, Beam):
            found[AbstractBody] += part.nodes
    bodies = found[AbstractBody]
    if not bodies:
        raise ValueError("There is no body in the scene: nothing can move.")
    for body in bodies:
        if body.kind.dimension != bodies[0].kind.dimension:
            raise ValueError(
                f"'{body.name}' is in {_world(body)}, but '{bodies[0].name}' in "
                f"{_world(bodies[0])}: a scene has one or the other."
            )
    return found


def _world(body: AbstractBody) -> str:
    return "the plane" if body.kind.dimension == 2 else "space"


def compile_parts(
    found: dict[type, list[Any]], gravity: Any, own: dict[str, Any]
) -> tuple[Layout, Parameters]:
    """The layout of sorted parts and its parameters; `own` are those of the user."""
    bodies = found[AbstractBody]
    beams = {beam.name: beam for beam in found[Beam]}
    loaded = [(load, _loaded_beam(load, beams)) for load in found[LineLoad]]
    named = tuple((body.name, body.kind) for body in bodies)
    rows = numbers_of(named)
    ends = _StartPose(bodies, rows, beams)
    resolved = {}
    for kind in LINKS:
        resolved[kind] = [(part, *resolved_part(part, ends(part))) for part in found[kind]]
        ends.hinges = _hinges(ends, resolved[AbstractJoint])
    # Contacts with a penalty are springs.
    contacts = resolved[AbstractContact]
    resolved[AbstractForce] += [x for x in contacts if not isinstance(x[1], Gap)]
    resolved[AbstractContact] = [x for x in contacts if isinstance(x[1], Gap)]
    links = {
        kind: tuple(
            Link(part.name, law, rows[part.a], rows[part.b]) for part, law, _ in parts
        )
        for kind, parts in resolved.items()
    }
    layout = Layout(
        dimension=bodies[0].kind.dimension,
        bodies=named,
        joints=links[AbstractJoint],
        forces=links[AbstractForce],
        constraints=tuple((part.name, part.function) for part in found[Constraint]),
        potentials=tuple((part.name, part.function) for part in found[Potential]),
        has_gravity=gravity is not None,
        drives=links[AbstractDrive],
        inerters=links[AbstractInerter],
        contacts=links[AbstractContact],
        beams=tuple(_beam_link(beam, rows) for beam in found[Beam]),
        line_loads=tuple(
            LineLoadLink(load.name, _rows_of_sections(beam, rows)) for load, beam in loaded
        ),
    )
    tables = dict(
        bodies=_tables(layout.body_groups, {b.name: b.numbers for b in bodies}),
        joints=_tables(layout.joint_groups, _by_name(resolved[AbstractJoint])),
        forces=_tables(layout.force_groups, _by_name(resolved[AbstractForce])),
        drives=_tables(layout.drive_groups, _by_name(resolved[AbstractDrive])),
        inerters=_tables(
            [group.links for group in layout.inerter_groups],
            _by_name(resolved[AbstractInerter]),
        ),
        contacts=_tables(layout.contact_groups, _by_name(resolved[AbstractContact])),
        beams=_tables(layout.beam_groups, {x.name: x.numbers for x in found[Beam]}),
        line_loads=_tables(
            layout.line_load_groups,
            {load.name: load.numbers(beam) for load, beam in loaded},
        ),
    )
    return layout, Parameters(tables, _own(own, gravity, layout, tables), layout)


def _beam_link(beam: Beam, rows: dict[str, int]) -> BeamLink:
    weights = tuple(weights_of(np.array(beam.places)).tolist())
    return BeamLink(beam.name, beam.law, _rows_of_sections(beam, rows), weights)


def _rows_of_sections(beam: Beam, rows: dict[str, int]) -> tuple[int, ...]:
    return tuple(rows[node.name] for node in beam.nodes)


def _loaded_beam(load: LineLoad, beams: dict[str, Beam]) -> Beam:
    if load.beam not in beams:
        raise ValueError(
            f"'{load.name}' acts on '{load.beam}', but there is no such beam. There are "
            f"{[*beams]}."
        )
    return beams[load.beam]


def _hinges(ends: "_StartPose", joints: list[tuple]) -> Hinges:
    found = []
    for part, law, numbers in joints:
        if law.keeps is None:
            continue
        of_a = ends(part).frames[0].axes
        axis = numbers["frame_a"][2] @ of_a if law.keeps == "axis" else None
        found.append(Hinge(part.name, frozenset((part.a, part.b)), axis))
    return Hinges(found)


def _own(own: dict[str, Any], gravity: Any, layout: Layout, tables: Any) -> dict[str, Any]:
    for key in (*tables, "gravity"):
        if key in own:
            raise ValueError(f"`args` of a scene must not hold '{key}': it has its own.")
    if gravity is None:
        return own
    vector = number("the scene", "`gravity`", gravity, (layout.dimension,))
    return own | dict(gravity=jnp.asarray(vector) * 1.0)


def _by_name(resolved: list[tuple]) -> dict[str, Numbers]:
    return {part.name: numbers for part, _, numbers in resolved}


def _tables(groups: Sequence[Any], numbers: dict[str, Numbers]) -> tuple[Numbers, ...]:
    """A dictionary of tables for each group, in which each part has one row."""
    tables = []
    for group in groups:
        members = [numbers[name] for name in group.names]
        table = {}
        for key in members[0]:
            entries = [member[key] for member in members]
            if any(np.shape(x) != np.shape(entries[0]) for x in entries):
                raise ValueError(f"`{key}` of {[*group.names]} must be of one shape.")
            table[key] = jnp.asarray(module_of(entries).stack(entries))
        tables.append(table)
    return tuple(tables)


class _StartPose:
    """Finds the bodies that a part connects, in the start pose."""

    def __init__(
        self, bodies: Sequence[AbstractBody], rows: dict[str, int], beams: Container[str]
    ):
        kinds = tuple((body.name, body.kind) for body in bodies)
        self._layout = Layout(
            dimension=bodies[0].kind.dimension,
            bodies=kinds,
            joints=(),
            forces=(),
            constraints=(),
            potentials=(),
            has_gravity=False,
        )
        self._rows, self._beams, self.hinges = rows, beams, Hinges()
        q = join([body.q for body in bodies])
        frames = _all_frames(self._layout, jnp.asarray(q))
        self._frames = jax.device_get(frames) if is_known(frames) else frames

    def __call__(self, part: Any) -> Ends:
        for body in (part.a, part.b):
            if not isinstance(body, str):
                raise TypeError(
                    f"'{part.name}' connects bodies by their names, got a "
                    f"{type(body).__name__}: write '{getattr(body, 'name', '...')}'."
                )
            if body in self._beams:
                raise ValueError(
                    f"'{part.name}' connects '{body}', which is a beam: connect one of its "
                    f"sections, '{body}:start' or '{body}:end', or one in between, "
                    "`beam.at(arc_length)`."
                )
            if body not in self._rows:
                raise ValueError(
                    f"'{part.name}' connects '{body}', but there is no such body. There "
                    f"are {[name for name in self._rows]}."
                )
        if part.a == part.b:
            raise ValueError(f"'{part.name}' connects '{part.a}' with itself.")
        numbers = self._rows[part.a], self._rows[part.b]
        a, b = (jax.tree.map(lambda x, k=k: x[k], self._frames) for k in numbers)
        turns = [k == 0 or bool(self._layout.turning[k]) for k in numbers]
        return Ends(
            part=f"'{part.name}'",
            bodies=(part.a, part.b),
            frames=(a, b),
            turns=(turns[0], turns[1]),
            hinges=self.hinges,
        )


@compiled_for_once
def _all_frames(layout: Layout, q: Coordinates) -> Frame:
    view = View(layout, q)
    return Frame(view.origins, view.axes, view.angles)


def start_of(
    layout: Layout, args: Parameters, bodies: Sequence[AbstractBody]
) -> tuple[Array, Array]:
    """The coordinates and velocities of the start; those of inerters come last."""
    q, v = (join([getattr(body, x) for body in bodies]) for x in ("q", "v"))
    if not layout.inerters:
        return q, v
    unknown = jnp.zeros((len(layout.inerters),), q.dtype)
    padded = lambda x: jnp.concatenate([x, unknown])
    values, rates = _of_inerters(layout, padded(q), padded(v), args)
    return jnp.concatenate([q, values]), jnp.concatenate([v, rates])


@compiled_for_once
def _of_inerters(
    layout: Layout, q: Coordinates, v: Velocities, args: Parameters
) -> tuple[Array, Array]:
    """The lengths and angles of all inerters, in the order of their coordinates, and their
    rates, from the coordinates and velocities of the bodies."""
    first = q.size - len(layout.inerters)

    def values(x: Coordinates) -> Array:
        own = jnp.zeros((len(layout.inerters),), x.dtype)
        groups = zip(layout.inerter_groups, args.tables["inerters"], strict=True)
        for group, numbers in groups:
            assert isinstance(group.links.law, Flywheel)
            measured = group.links._replace(law=group.links.law.measure)
            found = evaluate(measured, View(layout, x), numbers)
            own = own.at[group.q - first].set(found)
        return own

    return jax.jvp(values, (q,), (lift(layout, q, v),))


def join(parts: Sequence[Any]) -> Array:
    return jnp.asarray(module_of(parts).concatenate(parts))
