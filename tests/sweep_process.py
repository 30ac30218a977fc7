"""A small sweep, which can run as a separate process: killed, resumed, or one of several.

python -m tests.sweep_process RESULT [--path FOLDER] [--die-after LANES]
                             [--process K --port P]
"""

import argparse
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np

import enerjax as ej


# The last of these is the start of no motion.
OVER = {"l": [0.5, 1.0, 2.0], "h": [1e-3, 2e-3, 5e-3, 1e-2, 2e-2], "g": [9.81, np.nan]}
STEPS = 20


def motion(l, h, g):
    system, start, _ = ej.problems.pendulum_angle()
    args = dict(m=1.0, l=l, g=g)
    solution = ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=h, num_steps=STEPS, throw=False
    )
    drift = jnp.max(jnp.abs(solution.audit.energy - solution.audit.energy[0]))
    return {"q": solution.ys.q[-1], "drift": drift, "result": solution.result}


def run_sweep(**options):
    return ej.sweep(motion, OVER, chunk=8, **options)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("result")
    parser.add_argument("--path")
    parser.add_argument("--die-after", type=int)
    parser.add_argument("--process", type=int)
    parser.add_argument("--port")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.process is not None:
        jax.distributed.initialize(f"127.0.0.1:{options.port}", 2, options.process)

    def progress(done, total):
        if options.die_after is not None and done >= options.die_after:
            os.kill(os.getpid(), signal.SIGKILL)

    found = run_sweep(path=options.path, progress=progress)
    np.savez(options.result, q=found.values["q"], drift=found.values["drift"])


if __name__ == "__main__":
    main()
