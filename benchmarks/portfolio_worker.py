"""One work of `portfolio.py` in a process of its own, by one program.

`python portfolio_worker.py PROGRAM WORK` prints what it has found as a line of JSON. Then
it makes a run for each line of its input, and prints the microseconds of a step. So several
processes can take turns. Input lines are numbers of motions; those for a gradient are
`run` and `gradient`.
"""

import time


_BEGIN = time.process_time()

import json  # noqa: E402
import resource  # noqa: E402
import sys  # noqa: E402
from collections.abc import Callable, Sequence  # noqa: E402
from functools import partial  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import harness  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from portfolio_works import Motion, scheme_of, Work, WORKS  # noqa: E402

import enerjax as ej  # noqa: E402


# The least processor time of a measurement. Shorter runs are repeated.
_LEAST_SECONDS = 0.05
# Other programs build their models before each run, which is not timed but takes longer.
_MOST_RUNS = 20
_PROJECT = Path(__file__).parents[1]
# How much finer the steps of a reference are.
_FINER = {"mujoco": 8, "exudyn": 10}
# Lengths of the steps of difference quotients, relative to the numbers.
_STEPS = (1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
# The relative difference from them above which a gradient is wrong. (They have round-off.)
_OFF = 1e-6
Record = dict[str, Any]
# From a word of the input to microseconds.
Timers = dict[str, Callable[[], float]]


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _first_call(fn: Callable, *args: Any) -> tuple[Any, Any, Record]:
    """The program of `fn`, its value, and what its first call costs."""
    times = [harness.clock()]
    traced = jax.jit(fn).trace(*args)
    times.append(harness.clock())
    lowered = traced.lower()
    times.append(harness.clock())
    program = lowered.compile()
    times.append(harness.clock())
    value = jax.block_until_ready(program(*args))
    times.append(harness.clock())
    names = ("trace_s", "lower_s", "xla_s", "execute_s")
    record = dict(zip(names, np.diff(times).tolist(), strict=True))
    return program, value, record | dict(first_call_s=times[-1] - times[0])


def _first_run(run: Callable[[], Any]) -> Record:
    """What the first call of a run costs that is not inside of `jit`."""
    spent: dict[str, float] = {"lower_s": 0.0, "xla_s": 0.0}
    events = {
        "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower_s",
        "/jax/core/compile/backend_compile_duration": "xla_s",
    }

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event in events:
            spent[events[event]] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    times = [harness.clock()]
    for _ in range(2):
        jax.block_until_ready(run())
        times.append(harness.clock())
    first, again = np.diff(times).tolist()
    rest = first - again - sum(spent.values())
    return spent | dict(trace_s=rest, execute_s=again, first_call_s=first)


def _seconds(run: Callable[[], Any]) -> float:
    """The mean time of a run."""
    begin, count = harness.clock(), 0
    while count == 0 or harness.clock() - begin < _LEAST_SECONDS:
        jax.block_until_ready(run())
        count += 1
    return (harness.clock() - begin) / count


def _timer(
    run: Callable[[], Any], steps: int, call: Callable[[], float] = lambda: 0.0
) -> Callable[[], float]:
    """A measurement of the microseconds of a step of `run`.

    `call()` are the seconds of `run` that do not belong to these `steps`.
    """
    return lambda: 1e6 * (_seconds(run) - call()) / steps


# Ours -------------------------------------------------------------------------------------


def _run(work: Work) -> tuple[Record, Timers]:
    begin = harness.clock()
    system, start, args = work.motions[0].problem()
    build_s, scheme = harness.clock() - begin, scheme_of(work.scheme)
    run_of = harness.run_of(system, scheme, work.steps)
    before_mb = _peak_mb()
    record = _first_run(lambda: run_of(start, args, work.motions[0].h))
    record |= dict(build_s=build_s, before_mb=before_mb, peak_mb=_peak_mb())
    explained = ej.explain(system, scheme, start, args)
    record |= dict(
        unknowns=sum(explained.unknowns.values()),
        operations=explained.operations,
        method=explained.method,
        matrices=explained.chord or explained.jacobian,
        # Without the folder of this copy of the project.
        obstacles=[x.replace(f"{_PROJECT}/", "") for x in explained.obstacles],
    )
    step_of = harness.run_of(system, scheme, 1)
    motions, timers, calls = [], {}, []
    for number, motion in enumerate(work.motions):
        _, start, args = motion.problem()
        run = lambda start=start, args=args, h=motion.h: run_of(start, args, h)
        step = lambda start=start, args=args, h=motion.h: step_of(start, args, h)
        motions.append(_quality(work, run()))
        jax.block_until_ready(step())
        call = lambda step=step: _seconds(step)
        calls.append(call())
        timers[str(number)] = _timer(run, work.steps - 1, call)
    return record | dict(motions=motions, call_ms=1e3 * calls[0]), timers


def _quality(work: Work, solution: ej.Solution) -> Record:
    """What a run is worth: its energy relative to the kinetic energy, its constraints."""
    audit, largest = solution.audit, lambda x: float(np.max(np.abs(x), initial=0.0))
    failed = bool(solution.result != ej.RESULTS.successful)
    return dict(
        failure=str(ej.RESULTS[solution.result]) if failed else None,
        balance=abs(float(audit.leak[-1])) / largest(audit.kinetic),
        level=largest(audit.constraint),
        rate=largest(audit.constraint_rate),
        corrections=float(np.sum(solution.stats.newton_iterations)) / work.steps,
        end=work.positions(solution.ys.q[-1]).tolist(),
    )


def _gradient(work: Work) -> tuple[Record, Timers]:
    """With respect to the start, the masses and the length of the step."""
    system, start, args = work.motions[0].problem()
    steps, scheme = work.gradient_steps, scheme_of(work.scheme)
    run = harness.run_of(system, scheme, steps)
    masses, rest = _split_masses(args)

    def end(p: Record) -> jax.Array:
        solution = run(p["start"], _merged(p["masses"], rest), p["h"])
        # NaN if the run failed, which no check lets pass.
        return jnp.sum(jnp.sin(solution.ys.q[-1]))

    numbers = dict(start=start, masses=masses, h=jnp.asarray(work.motions[0].h))
    before_mb = _peak_mb()
    reverse, (_, gradient), record = _first_call(jax.value_and_grad(end), numbers)
    memory = reverse.memory_analysis().temp_size_in_bytes
    record |= dict(before_mb=before_mb, peak_mb=_peak_mb(), bytes_per_step=memory / steps)
    forward = jax.jit(end).lower(numbers).compile()
    moves = [
        partial(_moved, system, numbers, rest, only_velocities=x) for x in (False, True)
    ]
    record |= dict(steps=steps, off=_disagreement(forward, moves, gradient))
    timers = {
        "run": _timer(lambda: forward(numbers), steps),
        "gradient": _timer(lambda: reverse(numbers), steps),
    }
    return record, timers


def _split_masses(args: Any) -> tuple[Any, Any]:
    """The masses in `args`, by their names, and the rest; `None` in place of the other."""
    paths, structure = jax.tree_util.tree_flatten_with_path(args)
    names = [jax.tree_util.keystr(path[-1:], simple=True) for path, _ in paths]
    is_mass = [name in ("mass", "m", "m1", "m2") for name in names]
    leaves = [jnp.asarray(leaf) for _, leaf in paths]
    pick = lambda on: structure.unflatten(
        [x if mass == on else None for x, mass in zip(leaves, is_mass, strict=True)]
    )
    return pick(True), pick(False)


def _merged(masses: Any, rest: Any) -> Any:
    choose = lambda x, y: y if x is None else x
    return jax.tree.map(choose, masses, rest, is_leaf=lambda x: x is None)


def _moved(
    system: Any, numbers: Record, rest: Any, eps: float, *, only_velocities: bool
) -> Record:
    """Numbers on a curve through `numbers`, with a consistent start.

    They move along a random direction with the speed of their own sizes; the coordinates
    stay with `only_velocities`.
    """
    rng = np.random.default_rng(0)
    shift = lambda x: x + eps * rng.normal(size=x.shape) * (0.1 + abs(np.asarray(x)))
    masses, h = jax.tree.map(shift, numbers["masses"]), shift(numbers["h"])
    q, v = numbers["start"].q, shift(numbers["start"].v)
    if not (only_velocities or getattr(system, "redundant", False)):
        q = shift(q)
    return dict(
        start=ej.initial_state(system, q, v, _merged(masses, rest)), masses=masses, h=h
    )


def _disagreement(
    value: Callable[[Record], jax.Array],
    moves: Sequence[Callable[[float], Record]],
    gradient: Record,
) -> float:
    """The relative difference of the gradient from difference quotients along a curve.

    The curve is the first of `moves` whose starts can be made consistent: the rods of a
    long chain may be too short beside its coordinates to move these.
    """
    off: list[float] = []
    for moved in moves:
        if not off:
            found = [_difference(value, moved, gradient, eps) for eps in _STEPS]
            off = [x for x in found if x is not None]
    # Long steps have an error of truncation, short ones one of round-off.
    least = min(off, default=np.nan)
    if not least < _OFF:
        raise ValueError(f"off by {least:.0e} from difference quotients, or they fail")
    return least


def _difference(
    value: Callable[[Record], jax.Array],
    moved: Callable[[float], Record],
    gradient: Record,
    eps: float,
) -> float | None:
    """The difference for one length of steps; `None` if a start cannot be repaired."""

    def slope(fn: Callable[[float], Any]) -> Any:
        """By four values: the error is of fourth order."""
        far, near, after, beyond = (fn(k * eps) for k in (-2, -1, 1, 2))
        quotient = lambda a, b, c, d: (a - d + 8 * (c - b)) / (12 * eps)
        return jax.tree.map(quotient, far, near, after, beyond)

    try:
        direction = slope(moved)
    except ValueError:
        return None
    by_gradient = sum(
        float(np.sum(x * y))
        for x, y in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True)
    )
    return abs(by_gradient / float(slope(lambda e: value(moved(e)))) - 1)


# From `import` to the first result, as in a script of a user.


def _script(work: Work, *, differentiates: bool) -> tuple[Record, Timers]:
    system, start, args = work.motions[0].problem()
    masses, rest = _split_masses(args)

    def height(masses: Any) -> jax.Array:
        solution = ej.simulate(
            system,
            scheme_of(work.scheme),
            start,
            _merged(masses, rest),
            h=work.motions[0].h,
            num_steps=work.steps,
        )
        return solution.ys.q[-1, -10]

    jax.block_until_ready((jax.grad(height) if differentiates else height)(masses))
    return dict(seconds=time.process_time(), peak_mb=_peak_mb()), {}


# Others -----------------------------------------------------------------------------------


def _peer(work: Work, program: str) -> tuple[Record, Timers]:
    """A program whose models have `run(h, steps)`."""
    models = harness.peer(f"{program}_models", program)
    motions, timers = [], {}
    for number, motion in enumerate(work.motions if models else ()):
        make = getattr(motion, program)
        model = make(models)
        try:
            _, end = model.run(motion.h, work.steps)
        except Exception as error:
            motions.append(dict(failure=str(error).strip()[-80:]))
            continue
        record = dict(failure=None, end=np.asarray(end).reshape(-1, 3).tolist())
        if motion.reference == program:
            finer = _FINER[program]
            _, fine = model.run(motion.h / finer, work.steps * finer)
            record |= dict(reference=np.asarray(fine).reshape(-1, 3).tolist())
        motions.append(record)

        def seconds(steps: int, model: Any = model, motion: Motion = motion) -> float:
            total, count = 0.0, 0
            while total < _LEAST_SECONDS and count < _MOST_RUNS:
                total, count = total + model.run(motion.h, steps)[0], count + 1
            return total / count

        timers[str(number)] = lambda of=seconds: (
            1e6 * (of(work.steps) - of(1)) / (work.steps - 1)
        )
    return dict(motions=motions), timers


def _diffrax(work: Work) -> tuple[Record, Timers]:
    """Tsit5 with the same steps, on our model, its constraints differentiated twice."""
    diffrax = harness.peer("diffrax", "diffrax")
    if diffrax is None:
        return dict(motions=[]), {}
    motion = work.motions[0]
    system, start, args = motion.problem()

    def run(start: ej.State, args: Any, h: jax.Array) -> Any:
        term, y0 = ej.to_diffrax(system, start, args)
        return diffrax.diffeqsolve(
            term,
            diffrax.Tsit5(),
            0.0,
            h * work.steps,
            h,
            y0,
            saveat=diffrax.SaveAt(t1=True),
            # The last step may fall a rounding error short of the end.
            max_steps=work.steps + 2,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        ).ys[0][0]

    inputs = start, args, jnp.asarray(motion.h)
    program, q, record = _first_call(run, *inputs)
    timers = {"0": _timer(lambda: program(*inputs), work.steps)}
    found = dict(failure=None, end=work.positions(q).tolist())
    return record | dict(motions=[found]), timers


_PROGRAMS: dict[str, Callable[[Work], tuple[Record, Timers]]] = {
    "run": _run,
    "gradient": _gradient,
    "script": lambda work: _script(work, differentiates=False),
    "script-gradient": lambda work: _script(work, differentiates=True),
    "exudyn": lambda work: _peer(work, "exudyn"),
    "mujoco": lambda work: _peer(work, "mujoco"),
    "diffrax": _diffrax,
}


def main() -> None:
    program, name = sys.argv[1:]
    jax.config.update("jax_enable_x64", True)
    record, timers = _PROGRAMS[program](WORKS[name])
    print(json.dumps(record), flush=True)
    for line in sys.stdin:
        print(timers[line.strip()](), flush=True)


if __name__ == "__main__":
    main()
