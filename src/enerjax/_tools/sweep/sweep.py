import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from ..._run import positive_integer
from .fingerprint import fingerprint
from .grid import make_grid
from .labelled import Sweep
from .program import Chunk, make_lane
from .store import Store


def sweep(
    fn: Callable[..., Any],
    over: Mapping[Any, Any],
    *,
    chunk: int = 1024,
    batch_size: int | None = None,
    sort_by: str | None = None,
    path: str | os.PathLike | None = None,
    progress: bool | Callable[[int, int], None] = False,
) -> Sweep:
    """The results of a function over a grid of parameters, all from one program.

        def lost(alpha, h):
            scheme = ej.EnergyConsistent(alpha)
            sol = ej.simulate(
                system, scheme, start, args, h=h, num_steps=500, saveat=..., throw=False
            )
            return {"energy": sol.audit.energy[-1], "result": sol.result}

        over = {"alpha": [0.0, 0.5, 1.0], "h": np.geomspace(1e-3, 0.1, 20)}
        swept = ej.sweep(lost, over)
        swept.values["energy"]  # shape (3, 20)
        swept.at(alpha=0.5).values["energy"]  # shape (20,)

    Lanes are vectorised in small batches, and go through one compiled program chunk by
    chunk: memory on the device is that of a chunk. Each device of the process takes an
    equal part of a chunk. Under `jax.distributed` the processes take chunks in turn, and
    all return the whole result.

    **Arguments:**

    - `fn`: takes the parameters by name and returns a pytree of arrays. It is traced: all
      parameters are numbers, not part of the program. Make runs with `throw=False`, and
      return their `result`: a lane that failed is then marked, and the others do not
      notice. With `throw=True` it would end the sweep.
    - `over`: the names of parameters and their values, a sequence for each; all
      combinations are run. A tuple of names stands for parameters that change together,
      `{("m", "l"): [[1.0, 0.5], [2.0, 0.7]]}`, a row for each point. The values of one name
      can also be arrays of any shape or pytrees of them (starts, `args`), stacked along a
      leading axis.
    - `chunk`: how many lanes are computed, reported and written at a time; rounded down to
      make them equal.
    - `batch_size`: how many lanes take their steps together. They wait for the slowest of
      them (on CPUs not those of small systems, which run one after the other). By default
      16 on CPUs, and as many as there are elsewhere.
    - `sort_by`: the name of the parameter that the work of a lane depends on most, such as
      `h` if all runs end at the same time: lanes that take their steps together are then
      alike.
    - `path`: a folder. Each chunk is written there as it is done, and a sweep that was
      stopped goes on from there if it is called again, also with other devices or
      processes.
    - `progress`: `True` for a line on stderr, or a function of the number of lanes that
      are done and that of all of this process.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` or `TypeError` for bad input, for a `fn` that returns anything
    else than arrays, and where `path` holds another sweep or a file that is damaged.
    """
    grid = make_grid(over)
    chunk = positive_integer("chunk", chunk)
    if batch_size is not None:
        batch_size = positive_integer("batch_size", batch_size)
    order = grid.order(sort_by)
    first = jax.tree.map(lambda x: x[0], grid.lanes(order[:1]))
    lane, traced = make_lane(fn, first)
    count = -(-grid.size // chunk)
    chunks = _equal(order, count)
    store = None if path is None else Store(path, fingerprint(grid, chunks, traced))
    # Those of this process; the others are made elsewhere.
    own = range(jax.process_index(), count, jax.process_count())
    lanes = [min(chunks.shape[1], order.size - k * chunks.shape[1]) for k in own]
    report = _reporter(progress, sum(lanes))
    run, done = Chunk(lane, chunks.shape[1], batch_size), {}
    for number in own:
        leaves = store.read(number) if store else None
        if leaves is None:
            leaves = run(grid.lanes(chunks[number]))
            if store:
                store.write(number, leaves)
        done[number] = leaves
        report(sum(lanes[: len(done)]))
    if jax.process_count() > 1:
        done = _exchange(done, count, traced.out_info, chunks.shape[1])
    columns = zip(*(done[number] for number in range(count)), strict=True)
    leaves = [_in_place(np.concatenate(column), order, grid.shape) for column in columns]
    values = jax.tree.unflatten(jax.tree.structure(traced.out_info), leaves)
    return Sweep(grid.axes, grid.values, values)


def _equal(order: np.ndarray, count: int) -> np.ndarray:
    """Lanes in chunks of one length, shape `(count, lanes)`; the last lane fills up."""
    length = -(-order.size // count)
    return np.pad(order, (0, count * length - order.size), "edge").reshape(count, length)


def _in_place(column: np.ndarray, order: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """From the order in which lanes were run to that of the grid."""
    placed = np.empty_like(column, shape=(order.size, *column.shape[1:]))
    placed[order] = column[: order.size]
    return placed.reshape(*shape, *column.shape[1:])


def _exchange(
    done: dict[int, list[np.ndarray]], count: int, like: Any, length: int
) -> dict[int, list[np.ndarray]]:
    """All chunks in all processes, a round of chunks at a time."""
    from jax.experimental import multihost_utils

    everywhere, processes = {}, jax.process_count()
    blank = [np.zeros((length, *x.shape), x.dtype) for x in jax.tree.leaves(like)]
    for begin in range(0, count, processes):
        mine = done.get(begin + jax.process_index(), blank)
        gathered = multihost_utils.process_allgather(mine)
        for k in range(min(processes, count - begin)):
            everywhere[begin + k] = [np.asarray(x)[k] for x in gathered]
    return everywhere


def _reporter(
    progress: bool | Callable[[int, int], None], total: int
) -> Callable[[int], None]:
    if callable(progress):
        return lambda done: progress(done, total)
    if not progress:
        return lambda done: None

    def line(done: int) -> None:
        end = "\n" if done == total or not sys.stderr.isatty() else ""
        start = "\r" if sys.stderr.isatty() else ""
        print(f"{start}{done} of {total} lanes", end=end, file=sys.stderr, flush=True)

    return line
