"""Programs of JAX as functions of machine code, on CPUs.

XLA's CPU back end calls a function for each of the hundred or so array operations of a
step, and the calls take longer than the operations. Here a program becomes a graph of
scalar operations (`graph.py`), in which zeros and known numbers are left out, and moving
entries of arrays (`values.py`) costs nothing. Equal operations on many bodies are loops
that use vectors, and so are the lanes of a batch (`kernels.py`), which several threads
share (`passes.py`). LLVM compiles the code (`emission.py`, `handler.py`, `compiler.py`),
and XLA calls it (`library.py`, `calls.py`). Other processes find it on disk
(`code_on_disk.py`).
"""

from .calls import (
    in_one_function as in_one_function,
    part as part,
    why_not_one_function as why_not_one_function,
)
