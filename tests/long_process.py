"""A run that is killed while it writes checkpoints.

python -m tests.long_process FILE

The first pieces wait for the clock, so that a checkpoint after the start is due. Then the
process kills itself, which no handler can catch.
"""

import itertools
import os
import signal
import sys
import time

import jax

import enerjax as ej
from enerjax._programs.machine_code import compiler


STEPS = 2003


def motion(num_steps=STEPS, **options):
    system, start, args = ej.problems.pendulum()
    return ej.simulate(
        system,
        ej.EnergyConsistent(0.5),
        start,
        args,
        h=0.01,
        num_steps=num_steps,
        saveat=ej.SaveAt(every=7),
        **options,
    )


def main():
    jax.config.update("jax_enable_x64", True)
    # As in the tests: at another level the digits of round-off are others.
    compiler.OPTIMISATION = 0
    pieces = itertools.count(1)

    def die_after_two_pieces(done, whole):
        time.sleep(1.0)
        if next(pieces) > 2:
            os.kill(os.getpid(), signal.SIGKILL)

    motion(progress=die_after_two_pieces, checkpoint=sys.argv[1], checkpoint_seconds=0.0)


if __name__ == "__main__":
    main()
