"""Names of the numbers of a run, for tables and files."""

import collections
from collections.abc import Sequence

import equinox as eqx


class Names(eqx.Module):
    """Names of the coordinates, velocities and constraints of a system.

    Tables and files use them: `System(..., names=Names(coordinates=["x", "y"]))`. Numbers
    without names are called `q0`, `v0` and `multiplier.0`. Scenes name theirs after bodies
    and joints.

    **Arguments:**

    - `coordinates`, `velocities`, `constraints`: a name for each entry of `q`, of `v`, and
      of the multipliers. They are optional.

    **Raises:** `ValueError` if a name occurs twice.
    """

    coordinates: tuple[str, ...] | None = eqx.field(static=True)
    velocities: tuple[str, ...] | None = eqx.field(static=True)
    constraints: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        coordinates: Sequence[str] | None = None,
        velocities: Sequence[str] | None = None,
        constraints: Sequence[str] | None = None,
    ):
        given = coordinates, velocities, constraints
        together = [name for names in given[:2] for name in names or ()]
        for names in (together, list(constraints or ())):
            name, count = collections.Counter(names).most_common(1)[0] if names else ("", 0)
            if count > 1:
                raise ValueError(f"`Names`: '{name}' occurs {count} times.")
        self.coordinates, self.velocities, self.constraints = (
            None if names is None else tuple(map(str, names)) for names in given
        )
