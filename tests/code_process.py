"""A program with branches in a process of its own, which may find its code on disk.

`python code_process.py FOLDER` prints the outputs, and how many graphs and modules it had
to make.
"""

import json
import sys

import jax
import jax.numpy as jnp

from enerjax._programs import in_one_function
from enerjax._programs.machine_code import code_on_disk, emission, library


def fn(x):
    turns = jnp.arange(60.0).reshape(20, 3)

    def many(x):
        for k in range(20):
            x = jnp.sin(x + turns[k]) + jnp.roll(x, 1) * x[0]
        return jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(3), x)[::-1]

    turn = lambda k, x: jax.lax.cond(x[k % 3] > 0.5, many, lambda x: x + 0.1, x)
    return jax.lax.fori_loop(0, 6, turn, x)


def counted(module, name, counts):
    make = getattr(module, name)

    def call(*args):
        counts[name] = counts.get(name, 0) + 1
        return make(*args)

    setattr(module, name, call)


def main():
    emission._LARGE_BRANCH = 50
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", sys.argv[1])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    counts = dict(graph_of=0, object_of=0)
    counted(library, "graph_of", counts)
    counted(library, "object_of", counts)
    counted(code_on_disk, "object_of", counts)
    lanes = jnp.linspace(0.1, 0.9, 12).reshape(4, 3)
    outputs = [jax.jit(in_one_function(fn))(lanes[0])]
    outputs += [jax.jit(jax.vmap(in_one_function(fn)))(lanes)]
    print(json.dumps(dict(outputs=[x.tolist() for x in outputs]) | counts))


if __name__ == "__main__":
    main()
