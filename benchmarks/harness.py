"""The harness of the benchmarks: one core, a process of its own, medians.

A benchmark starts itself once more, with `--child`, so that other programs do not share its
process; the child prints its rows as the last line of its output.
"""

import argparse
import csv
import dataclasses
import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import enerjax as ej


Row = dict[str, Any]
RESULTS = Path(__file__).parent / "results"
DOCUMENTED = Path(__file__).parents[1] / "docs" / "pictures"
_TIME = "us_per_step"
# With these settings XLA compiles loops of any size into one function, which loops of
# diffrax profit by.
FAST_LOOPS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000 "
    "--xla_cpu_experimental_ynn_fusion_type=-dot,-reduce,-eltwise "
    "--xla_cpu_use_fusion_emitters=false"
)


def run(
    script: str,
    rows_of: Callable[..., list[Row]],
    show: Callable[[list[Row]], None],
    draw: Callable[[list[Row], Path], None],
    peers: Callable[..., list[Row]] = lambda quick: [],
    works: Sequence[str] = (),
    xla_flags: str = "",
) -> None:
    """The main program of a benchmark.

    `rows_of` measures our rows in a separate process, and `peers` those of other programs
    in this process (twice if these measure the time of a step). Both get a flag for a quick
    run. The rows are printed, drawn, and saved under the name of the script; a picture that
    the documentation shows is replaced there. With `works` both also get the names of the
    works to measure; each row has its name as `work`, and replaces saved rows of the same
    work. The separate process has these `xla_flags`.
    """
    chosen = _options(sys.modules["__main__"].__doc__ or "", works)
    asked = (
        (chosen.quick, [chosen.only] if chosen.only else works)
        if works
        else (chosen.quick,)
    )
    pin()
    if chosen.child:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(rows_of(*asked)))
        return
    jax.config.update("jax_enable_x64", True)
    flags = ["--quick"] if chosen.quick else []
    flags += ["--only", chosen.only] if chosen.only else []
    others = peers(*asked)
    rows = _rows_of_child(script, flags, xla_flags)
    if any(_TIME in row for row in others):
        # Their runs cannot alternate with ours. They run before and after, and the faster
        # time counts.
        pairs = zip(others, peers(*asked), strict=True)
        others = [min(pair, key=lambda row: row[_TIME]) for pair in pairs]
    rows = others + rows
    show(rows)
    chosen.out.mkdir(parents=True, exist_ok=True)
    saved = chosen.out / f"{Path(script).stem}.json"
    if chosen.only and saved.exists():
        old = json.loads(saved.read_text())
        rows = [row for row in old if row["work"] != chosen.only] + rows
    saved.write_text(json.dumps(rows, indent=1))
    picture = saved.with_suffix(".png")
    shown = DOCUMENTED / picture.name
    draw(rows, shown if chosen.out == RESULTS and shown.exists() else picture)


def _options(doc: str, works: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=doc.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--quick", action="store_true", help="less work, rougher times")
    parser.set_defaults(only=None)
    if works:
        parser.add_argument("--only", choices=works, help="one of its problems")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def pin() -> None:
    """Restricts this process to one core, so that times are comparable."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def _rows_of_child(script: str, flags: list[str], xla_flags: str) -> list[Row]:
    command = [sys.executable, script, "--child", *flags]
    all_flags = f"{os.environ.get('XLA_FLAGS', '')} {xla_flags}".strip()
    env = os.environ | ({"XLA_FLAGS": all_flags} if all_flags else {})
    out = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=env)
    *messages, data = out.stdout.splitlines()
    print("\n".join(messages)) if messages else None
    return [dict(mode="enerjax") | row for row in json.loads(data)]


def write_csv(rows: Sequence[Any], path: Path) -> None:
    """A table of dataclasses of one kind."""
    with path.open("w", newline="") as file:
        names = [field.name for field in dataclasses.fields(rows[0])]
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(dataclasses.asdict(row) for row in rows)


def device() -> Row:
    first = jax.devices()[0]
    return dict(platform=first.platform, device=first.device_kind)


def clock() -> float:
    """Processor seconds, so that other processes do not count; wall time on a GPU."""
    on_cpu = jax.default_backend() == "cpu"
    return time.process_time() if on_cpu else time.perf_counter()


def compiled(fn: Callable, *args: Any) -> tuple[Any, float]:
    """The program of `fn`, and the seconds that it took to compile."""
    begin = clock()
    program = jax.jit(fn).lower(*args).compile()
    return program, clock() - begin


def run_of(
    system: ej.AbstractSystem,
    scheme: ej.AbstractScheme,
    steps: int,
    *,
    every: int | None = None,
) -> Callable[..., ej.Solution]:
    """A run of `steps` steps as a function of `(start, args, h)`, saved at every `every`-th
    step or at its end. The caller must check the error, which shows a failed run."""

    def run(start: ej.State, args: Any, h: Any) -> ej.Solution:
        saveat = ej.SaveAt(every=steps if every is None else every)
        mechanism = (system, scheme, start, args)
        return ej.simulate(*mechanism, h=h, num_steps=steps, saveat=saveat, throw=False)

    return run


@dataclasses.dataclass(frozen=True)
class CompiledRun:
    """A compiled run of `steps` steps, and the solution of its first execution.

    `program` is a function of `inputs`, and took `compile_s` seconds to compile.
    """

    program: Any
    inputs: tuple[ej.State, Any, float]
    steps: int
    compile_s: float
    solution: ej.Solution

    def again(self) -> ej.Solution:
        return self.program(*self.inputs)

    def corrections(self) -> float:
        """The Newton corrections of a step, on average."""
        return float(np.sum(self.solution.stats.newton_iterations)) / self.steps

    def residuals(self) -> tuple[float, float, float]:
        """The largest difference of energies, and the largest residuals of the constraints
        at position and velocity level."""
        audit = self.solution.audit
        levels = (audit.constraint, audit.constraint_rate)
        level, rate = (float(np.max(np.abs(x))) for x in levels)
        return float(np.ptp(audit.energy)), level, rate


def compiled_run(
    problem: tuple[ej.AbstractSystem, ej.State, Any],
    scheme: ej.AbstractScheme,
    h: float,
    steps: int,
) -> CompiledRun:
    """Compiles a run, which is saved at its end, and executes it once."""
    system, start, args = problem
    inputs = (start, args, h)
    program, seconds = compiled(run_of(system, scheme, steps), *inputs)
    return CompiledRun(program, inputs, steps, seconds, program(*inputs))


def add_step_times(runs: Sequence[tuple[Row, CompiledRun]], repeats: int) -> None:
    """Adds the time of a step in microseconds to the row of each run."""
    times = medians([run.again for _, run in runs], repeats)
    for (row, run), seconds in zip(runs, times, strict=True):
        row[_TIME] = 1e6 * seconds / run.steps


def peer(module: str, program: str) -> Any:
    """A module that needs another program, or without this program `None` and a message."""
    try:
        return importlib.import_module(module)
    except ImportError:
        print(f"{program} is not installed (extra `peers`): no rows to compare with")
        return None


def medians(programs: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
    """Seconds of each program. They run in turn, so that other load affects all of them."""
    times: list[list[float]] = [[] for _ in programs]
    for _ in range(repeats):
        for program, record in zip(programs, times, strict=True):
            begin = clock()
            jax.block_until_ready(program())
            record.append(clock() - begin)
    return [statistics.median(record) for record in times]
