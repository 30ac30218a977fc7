"""The text that `print(scene)` shows."""

from collections.abc import Callable

from ._layout import Layout


def summary(
    layout: Layout,
    kinds: dict[str, str],
    ends: dict[str, tuple[str, str]],
    rows: dict[str, slice],
    slips: dict[str, slice],
    may_repeat: bool,
    count: Callable[[], int | None],
) -> str:
    """A list of all parts with their classes, coordinates and constraints.

    If constraints may be redundant, or must be because they outnumber the velocities,
    `count` finds the degrees of freedom.
    """
    bodies, joined = dict(layout.bodies), {x for pair in ends.values() for x in pair}
    places = [*rows.values(), *slips.values()]
    held = sum(place.stop - place.start for place in places)
    internal = sum(kind.num_internal for kind in bodies.values())
    independent = layout.num_velocities - internal - held
    freedoms, least = independent, ""
    if may_repeat or independent <= 0:
        counted = count()
        freedoms = max(independent, 0) if counted is None else counted
        least = "at least " if counted is None else ""
    world = "the plane" if layout.dimension == 2 else "space"
    holders = " and ".join(
        ["joints", *["inerters"] * bool(layout.inerters), *["drives"] * bool(layout.drives)]
    )
    lines = [
        f"A scene in {world}: {layout.num_coordinates} coordinates, {held} constraints of "
        f"{holders}, {least}{freedoms} degree{'' if freedoms == 1 else 's'} of freedom."
    ]
    if freedoms > independent and not may_repeat:
        lines.append(
            f"{freedoms - independent} of the constraints repeat others: leave them out, "
            "or declare `Scene(..., redundant=True)`."
        )
    width = max(len(name) for name in kinds)
    line = lambda name, text: f"  {name:{width}}  {kinds[name]:14}  {text}".rstrip()
    first = 0
    for name, sections in _with_beams(layout).items():
        last = first + sum(bodies[section].num_coordinates for section in sections)
        free = "" if joined & {*sections} else ", connected to nothing"
        lines.append(line(name, f"q[{first}:{last}]{free}"))
        first = last
    own = {link.name: first + k for k, link in enumerate(layout.inerters)}
    for name, place in rows.items():
        between = " - ".join(ends[name]) + ", " if name in ends else ""
        between += f"q[{own[name]}], " if name in own else ""
        if place.stop > place.start or name not in slips:
            between += f"constraint[{place.start}:{place.stop}], "
        if name in slips:
            slip = slips[name]
            between += f"nonholonomic[{slip.start}:{slip.stop}], "
        lines.append(line(name, between.removesuffix(", ")))
    shown = {*bodies, *rows, *(beam.name for beam in layout.beams)}
    others = [name for name in kinds if name not in shown]
    lines += [line(name, " - ".join(ends.get(name, ()))) for name in others]
    return "\n".join(lines)


def _with_beams(layout: Layout) -> dict[str, tuple[str, ...]]:
    """The bodies of each part with coordinates: itself, or the sections of a beam."""
    row_names = [*layout.numbers_of_bodies]
    beams = {
        row_names[beam.sections[0]]: (
            beam.name, tuple(row_names[row] for row in beam.sections)
        )
        for beam in layout.beams
    }  # fmt: skip
    inner = {name for _, sections in beams.values() for name in sections[1:]}
    found = {}
    for name, _ in layout.bodies:
        if name not in inner:
            part, sections = beams.get(name, (name, (name,)))
            found[part] = sections
    return found
