"""What a seeded fault is."""

from typing import NamedTuple


class Fault(NamedTuple):
    """A mistake in one place of the sources; see `seeded_faults.py`.

    - `name`: its own.
    - `file`: below `src/enerjax`.
    - `old`, `new`: a text that the file holds just once, and the mistake in its place.
    - `wrong`: what is wrong, in one sentence.
    - `tests`: what ought to notice, test files or tests in them, below the root of the
      project.
    """

    name: str
    file: str
    old: str
    new: str
    wrong: str
    tests: tuple[str, ...]


def of(*names: str) -> tuple[str, ...]:
    """Where tests are: of a file `"energy"`, of one of its tests `"energy::test_..."`."""
    places = [name.partition("::") for name in names]
    return tuple(f"tests/test_{file}.py{mark}{test}" for file, mark, test in places)
