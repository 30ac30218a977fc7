"""Every kind of work beside other programs: times, first calls, gradients, memory, errors.

    python benchmarks/portfolio.py [--out FOLDER] [--quick] [--only WORK ...]

The works are in `portfolio_works.py`: bodies in space and in the plane, points, tops, and
systems in angles, with default settings, beside EXUDYN (the generalized-alpha method),
MuJoCo (Runge-Kutta in the coordinates of the joints) and diffrax (Tsit5 on our model) where
they can do the same work (extra `peers`). Each program does each work in a process of its
own, so that the first call and the memory are its own. All are on one core, and take turns:
a ratio is the median of those of runs right after one another. All times are those of the
processor. The time of a step is that of a run without that of a run of one step, which is
mostly the call. Errors are the largest of any position at the end, in metres, against a
closed form, an explicit run in minimal coordinates at tight tolerance, or another program
with finer steps. Gradients, with respect to the start, the masses and the step, are
compared with difference quotients. `--quick` does a few works; `--only` keeps what is saved
of others. Writes portfolio.json, .md and .png; the table is that of
`docs/speed-and-accuracy.md`.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import harness
import numpy as np
from portfolio_table import draw, table
from portfolio_works import Motion, Work, WORKS


ROUNDS, QUICK_ROUNDS = 7, 2
QUICK = ("bodies-2", "four-bar-in-space", "points-8", "slider-crank", "pendulum")
SCRIPT = Path(__file__).with_name("portfolio_worker.py")
PEERS = ("exudyn", "mujoco", "diffrax")
Record = dict[str, Any]


class Worker:
    """A process of `portfolio_worker.py`; `record` is what it found, or its failure."""

    def __init__(self, program: str, work: Work):
        self.program = program
        self._process = subprocess.Popen(
            [sys.executable, str(SCRIPT), program, work.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.record: Record = self._found()

    def _found(self) -> Record:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                return json.loads(line)
            print(line, end="")
        assert self._process.stderr is not None
        last = self._process.stderr.read().strip().splitlines()[-1:]
        return dict(motions=[], failure=" ".join(last)[-200:])

    def us_per_step(self, word: str) -> float:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(word, file=self._process.stdin, flush=True)
        return float(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


def measured(work: Work, rounds: int) -> list[Record]:
    """The rows of a work, one for each motion."""
    programs = [p for p in PEERS if any(getattr(m, p) for m in work.motions)]
    workers = [Worker("run", work), *(Worker(p, work) for p in programs)]
    ours, peers = workers[0], workers[1:]
    rows = []
    for number, motion in enumerate(work.motions):
        row: Record = dict(work=motion.name, scheme=work.scheme, h=motion.h)
        row |= dict(steps=work.steps, bars=vars(motion.bars), peers={})
        rows.append(row)
        if "failure" in ours.record:
            row["failure"] = ours.record["failure"]
            continue
        row |= ours.record["motions"][number]
        taking = [w for w in workers if w is ours or _has_run(w, number)]
        times = [[w.us_per_step(str(number)) for w in taking] for _ in range(rounds)]
        row["us_per_step"] = statistics.median(turn[0] for turn in times)
        reference = _reference(motion, number, peers)
        row["error"] = _distance(row.pop("end"), reference)
        for worker in peers:
            if worker.record["motions"]:
                found = worker.record["motions"][number]
                row["peers"][worker.program] = dict(
                    failure=found["failure"], error=_distance(found.get("end"), reference)
                )
        for place, worker in enumerate(taking[1:], start=1):
            peer = row["peers"][worker.program]
            peer["us_per_step"] = statistics.median(turn[place] for turn in times)
            peer["ratio"] = statistics.median(turn[0] / turn[place] for turn in times)
    for worker in workers:
        worker.close()
    once = {k: x for k, x in ours.record.items() if k != "motions"}
    rows[0] |= once | _gradient(work, rounds)
    for row in rows[1:]:
        # The program of the first row.
        row |= {k: once[k] for k in _OF_PROGRAM if k in once}
    return rows


_OF_PROGRAM = ("unknowns", "operations", "method", "matrices", "obstacles")


def _has_run(worker: Worker, number: int) -> bool:
    motions = worker.record["motions"]
    return len(motions) > number and motions[number]["failure"] is None


def _reference(motion: Motion, number: int, peers: list[Worker]) -> Any:
    if callable(motion.reference):
        return motion.reference()
    for worker in peers:
        if worker.program == motion.reference and worker.record["motions"]:
            return worker.record["motions"][number].get("reference")
    return None


def _distance(end: Any, reference: Any) -> float | None:
    """The largest difference of positions; NaN of a failed run."""
    if end is None or reference is None:
        return None
    one, other = np.asarray(end), np.asarray(reference)
    if one.shape != other.shape:
        # One program is in the plane, the other in space.
        one, other = _own_axes(one), _own_axes(other)
    return float(np.max(np.abs(one - other)))


def _own_axes(positions: np.ndarray) -> np.ndarray:
    """Without the axes of space that a motion in a plane does not use."""
    return positions[:, np.any(np.abs(positions) > 1e-9, axis=0) | np.isnan(positions[0])]


def _gradient(work: Work, rounds: int) -> Record:
    worker = Worker("gradient", work)
    record = worker.record
    if "failure" not in record:
        turns = [
            [worker.us_per_step(word) for word in ("run", "gradient")]
            for _ in range(rounds)
        ]
        record["ratio"] = statistics.median(b / a for a, b in turns)
        record["us_per_step"] = statistics.median(b for _, b in turns)
    worker.close()
    return dict(gradient=record)


def scripts(work: Work) -> list[Record]:
    """From `import` to the first result, and to the first gradient."""
    bars = {"script": 8.0, "script-gradient": 12.0}
    rows = []
    for program, bar in bars.items():
        worker = Worker(program, work)
        rows.append(dict(work=work.name, program=program, bar=bar) | worker.record)
        worker.close()
    return rows


def environment(rounds: int) -> Record:
    names = ("enerjax", "jax", "jaxlib", "exudyn", "mujoco", "diffrax", "numpy")
    return dict(
        date=time.strftime("%Y-%m-%d"),
        processor=_processor(),
        cores=os.cpu_count(),
        pinned_to=sorted(os.sched_getaffinity(0)),
        load_at_start=os.getloadavg(),
        python=platform.python_version(),
        versions={name: _version(name) for name in names},
        times=(
            "seconds of the processor, on one core of a machine that other programs use; "
            f"medians of {rounds} rounds, in which the programs take turns"
        ),
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="a few works, rougher times")
    parser.add_argument("--only", nargs="+", choices=WORKS, help="some of the works")
    return parser.parse_args()


def _all_rows(names: list[str], rounds: int) -> Iterator[tuple[str, Record]]:
    for name in names:
        work = WORKS[name]
        for row in measured(work, rounds):
            yield "rows", row
        if name == "arm-4":
            for row in scripts(work):
                yield "scripts", row


def main() -> None:
    options = _options()
    harness.pin()
    names = list(options.only or (QUICK if options.quick else WORKS))
    rounds = QUICK_ROUNDS if options.quick else ROUNDS
    path = options.out / "portfolio.json"
    options.out.mkdir(parents=True, exist_ok=True)
    found: Record = dict(environment=environment(rounds), rows=[], scripts=[])
    if options.only and path.exists():
        saved = json.loads(path.read_text())
        found |= dict(rows=saved["rows"], scripts=saved["scripts"])
    for kind, row in _all_rows(names, rounds):
        same = lambda old, row=row: all(
            old.get(k) == row.get(k) for k in ("work", "program")
        )
        places = [k for k, old in enumerate(found[kind]) if same(old)]
        if places:
            found[kind][places[0]] = row
        else:
            found[kind].append(row)
        print(json.dumps({k: x for k, x in row.items() if k != "bars"})[:400], flush=True)
        # After each row: the whole takes an hour.
        path.write_text(json.dumps(found, indent=1))
    text = table(found)
    print(text)
    path.with_suffix(".md").write_text(text)
    draw(found["rows"], path.with_suffix(".png"))


if __name__ == "__main__":
    main()
