"""Reports of how far a long computation has come."""

import sys
import time
from collections.abc import Callable
from typing import Any

from typing_extensions import TypeAliasType


# Whether to report, or a function that is called with what is done and with the whole.
Progress = TypeAliasType("Progress", bool | Callable[[Any, Any], None])


def check_progress(progress: Any) -> None:
    if not (isinstance(progress, bool) or callable(progress)):
        raise TypeError(
            "`progress` must be `True`, or a function of what is done and of the whole, "
            f"got {progress!r}."
        )


class Line:
    """A line of text on stderr, which terminals and notebooks overwrite again and again.

    Elsewhere, as in the file of a batch job, lines follow each other at least `pause`
    seconds apart.
    """

    def __init__(self, pause: float = 0.0):
        self._in_place = sys.stderr.isatty() or "ipykernel" in sys.modules
        self._pause = 0.1 if self._in_place else pause
        self._shown = -float("inf")
        self._width = 0

    def show(self, text: str, is_last: bool) -> None:
        now = time.monotonic()
        if now - self._shown < self._pause and not is_last:
            return
        self._shown = now
        if not self._in_place:
            print(text, file=sys.stderr, flush=True)
            return
        # Blanks overwrite the end of a longer line.
        self._width = max(self._width, len(text))
        end = "\n" if is_last else ""
        print(f"\r{text:{self._width}}", end=end, file=sys.stderr, flush=True)
