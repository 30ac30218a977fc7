"""Python's searches for garbage while programs are made.

To trace and compile a program makes millions of small objects that live until it is
compiled. With its own settings, Python searches them for unreachable cycles so often that a
tenth of the time goes there.
"""

import contextlib
import gc
import threading
from collections.abc import Iterator


# How many new objects cause a search, and how many searches a wider one.
_RARELY = 50_000, 20, 100
_lock = threading.Lock()
# The settings before, once for each block that has begun, in any thread.
_usual: list[tuple[int, int, int]] = []


@contextlib.contextmanager
def few_searches_for_garbage() -> Iterator[None]:
    """Makes searches rare within a `with` block, or within a function."""
    with _lock:
        usual = _usual[0] if _usual else gc.get_threshold()
        _usual.append(usual)
        # A first number of zero means that the user wants no searches at all.
        if usual[0] > 0:
            gc.set_threshold(*map(max, usual, _RARELY))
    try:
        yield
    finally:
        with _lock:
            _usual.pop()
            if not _usual:
                gc.set_threshold(*usual)
