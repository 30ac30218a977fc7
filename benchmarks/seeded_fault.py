"""What a seeded fault is."""

from typing import NamedTuple


class Fault(NamedTuple):
    """A mistake in one place of the sources; see `seeded_faults.py`.

    - `name`: its own.
    - `file`: below `src/enerjax`.
    - `old`, `new`: a text that the file holds just once, and the mistake in its place.
    - `wrong`: what is wrong, in one sentence.
    - `tests`: the files that ought to notice, below the root of the project, most
      likely first.
    """

    name: str
    file: str
    old: str
    new: str
    wrong: str
    tests: tuple[str, ...]


def of(*names: str) -> tuple[str, ...]:
    """The paths of test files."""
    return tuple(f"tests/test_{name}.py" for name in names)
