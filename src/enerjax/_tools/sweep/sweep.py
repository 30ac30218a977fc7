import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from ..._progress import check_progress, Line, Progress
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
    progress: Progress = False,
) -> Sweep:
    """Evaluates a function over a grid of parameters, with one compiled program.

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

    Each combination of parameters is a lane. Lanes are vectorised in small batches and run
    chunk by chunk, so that the memory of the device must hold one chunk. All devices of the
    process share the lanes of a chunk. Under `jax.distributed` the processes take chunks in
    turn, and all return the whole result.

    **Arguments:**

    - `fn`: takes the parameters by name and returns a pytree of arrays. The parameters are
      traced. Use `throw=False` in runs and return their `result`: failed lanes are then
      marked and do not affect the others. With `throw=True` one would end the sweep.
    - `over`: a dictionary of parameter names and sequences of values; all combinations are
      run. A tuple of names stands for parameters that change together, with one row for
      each point: `{("m", "l"): [[1.0, 0.5], [2.0, 0.7]]}`. The values of one name can also
      be arrays of any shape, or pytrees of them (starts, `args`), stacked along a leading
      axis.
    - `chunk`: the largest number of lanes that are computed, reported and written at a
      time; all chunks have the same length.
    - `batch_size`: how many lanes are vectorised. They all wait for the slowest of them,
      except on CPUs, where only four lanes wait for each other if they are machine code.
      By default 64 on CPUs, and all lanes of a chunk elsewhere.
    - `sort_by`: the name of the parameter that the work of a lane depends on most, such as
      `h` if all runs end at the same time. Lanes of a batch then take similar times.
    - `path`: a folder to which each finished chunk is written. If the same sweep is called
      again after an interruption it is resumed from there, even with other devices or
      processes.
    - `progress`: `True` for a line on stderr, or a function of the numbers of finished
      lanes and of all lanes of this process.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` or `TypeError` for bad input, for a `fn` that returns anything
    but arrays, and if `path` holds another sweep or a damaged file.
    """
    check_progress(progress)
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
    # The chunks of this process.
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
    leaves = [_unsorted(np.concatenate(column), order, grid.shape) for column in columns]
    values = jax.tree.unflatten(jax.tree.structure(traced.out_info), leaves)
    return Sweep(grid.axes, grid.values, values)


def _equal(order: np.ndarray, count: int) -> np.ndarray:
    """Lanes in chunks of equal length, `(count, lanes)`; the last lane is repeated."""
    length = -(-order.size // count)
    return np.pad(order, (0, count * length - order.size), "edge").reshape(count, length)


def _unsorted(column: np.ndarray, order: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Results in the order of the grid, from those in the order of the runs."""
    result = np.empty_like(column, shape=(order.size, *column.shape[1:]))
    result[order] = column[: order.size]
    return result.reshape(*shape, *column.shape[1:])


def _exchange(
    done: dict[int, list[np.ndarray]], count: int, like: Any, length: int
) -> dict[int, list[np.ndarray]]:
    """The chunks of all processes; one chunk of each process is exchanged at a time."""
    from jax.experimental import multihost_utils

    gathered_chunks, processes = {}, jax.process_count()
    blank = [np.zeros((length, *x.shape), x.dtype) for x in jax.tree.leaves(like)]
    for begin in range(0, count, processes):
        mine = done.get(begin + jax.process_index(), blank)
        gathered = multihost_utils.process_allgather(mine)
        for k in range(min(processes, count - begin)):
            gathered_chunks[begin + k] = [np.asarray(x)[k] for x in gathered]
    return gathered_chunks


def _reporter(progress: Progress, total: int) -> Callable[[int], None]:
    if callable(progress):
        return lambda done: progress(done, total)
    if not progress:
        return lambda done: None

    line = Line()
    return lambda done: line.show(f"{done} of {total} lanes", is_last=done == total)
