"""Computations of small systems as one function of machine code, on CPUs.

These are loops over steps, and their derivatives. XLA's CPU back end calls a function for
each of the hundred or so array operations of a step, and the calls take longer than the
operations. It has a remedy for small loops (see `fast_loops.py`), which compiles all of a
computation into one function, and it takes any call that is marked as one of these. Not
every operation is possible inside: only those which need nothing from the runtime.
"""

from .calls import in_one_function as in_one_function, unmerged as unmerged
from .possible import LARGEST_SUM as LARGEST_SUM
from .products import written_out as written_out
