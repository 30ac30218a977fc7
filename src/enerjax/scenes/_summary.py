"""A scene in words."""

from ._layout import Layout


def summary(
    layout: Layout,
    kinds: dict[str, str],
    ends: dict[str, tuple[str, str]],
    rows: dict[str, slice],
    may_repeat: bool,
    freedoms: int | None,
) -> str:
    """Bodies, joints, forces and drives with what they are and what they count for.

    `freedoms` are those that were counted, where joints may repeat each other.
    """
    bodies, joined = dict(layout.bodies), {x for pair in ends.values() for x in pair}
    held = sum(place.stop - place.start for place in rows.values())
    least = ""
    if freedoms is None:
        internal = sum(kind.num_internal for kind in bodies.values())
        independent = layout.num_velocities - internal - held
        freedoms, least = max(independent, 0), "at least " if may_repeat else ""
    world = "the plane" if layout.dimension == 2 else "space"
    holders = "joints and drives" if layout.drives else "joints"
    lines = [
        f"A scene in {world}: {layout.num_coordinates} coordinates, {held} constraints of "
        f"{holders}, {least}{freedoms} degree{'' if freedoms == 1 else 's'} of freedom."
    ]
    width = max(len(name) for name in kinds)
    line = lambda name, text: f"  {name:{width}}  {kinds[name]:14}  {text}".rstrip()
    first = 0
    for name, kind in bodies.items():
        last = first + kind.num_coordinates
        free = "" if name in joined else ", connected to nothing"
        lines.append(line(name, f"q[{first}:{last}]{free}"))
        first = last
    for name, place in rows.items():
        between = " - ".join(ends[name]) + ", " if name in ends else ""
        lines.append(line(name, f"{between}constraint[{place.start}:{place.stop}]"))
    others = [name for name in kinds if name not in bodies and name not in rows]
    lines += [line(name, " - ".join(ends.get(name, ()))) for name in others]
    return "\n".join(lines)
