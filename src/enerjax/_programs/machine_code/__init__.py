"""Programs of JAX as functions of machine code, on CPUs.

XLA's CPU back end calls a function for each of the hundred or so array operations of a step,
and the calls take longer than the operations. Here a program becomes a graph of scalar
operations in which zeros and known numbers are left out, moving entries of arrays costs
nothing, and loops over bodies use vectors. LLVM compiles it, and XLA calls it.
"""

from .calls import (
    in_one_function as in_one_function,
    part as part,
    why_not_one_function as why_not_one_function,
)
