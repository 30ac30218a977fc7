"""Computations of small systems as one function of machine code, on CPUs.

The computations are loops over steps, and their derivatives. XLA's CPU back end calls a
function for each of the hundred or so array operations of a step, and the calls take longer
than the operations. XLA can compile a small loop into one function (see `fast_loops.py`),
and does the same with any call that carries the mark of such a loop. Only operations that
need nothing from XLA's runtime are possible inside.
"""
