"""Random systems, gradients and functions; every property that is violated is a finding.

`python benchmarks/fuzz.py --seed 0 --minutes 10 [--only KIND] [--block N]`. Work comes in
blocks, each of which compiles one structure and runs it with many numbers. Block `N` of a
seed is always the same, so the command in the line of a finding reproduces it.
"""

import argparse
import collections
import dataclasses
import importlib
import json
import os
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from fuzz_case import Result


KINDS = ("systems", "gradients", "functions")
# Compilation is most of the work.
FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


@dataclasses.dataclass(frozen=True)
class Done:
    """A case that has run; `case` counts within its block."""

    kind: str
    seed: int
    block: int
    case: int
    label: str
    result: Result


def block(kind: str, seed: int, number: int) -> Iterator[Done]:
    """The cases of one block; a crash is a finding."""
    cases: Callable[..., Any] = importlib.import_module(f"fuzz_{kind}").cases
    rng = np.random.default_rng([seed, KINDS.index(kind), number])
    made = enumerate(cases(rng, number))
    while True:
        try:
            case, (label, check) = next(made)
        except StopIteration:
            break
        except Exception as error:
            yield Done(
                kind=kind,
                seed=seed,
                block=number,
                case=-1,
                label="no case",
                result=crash(error),
            )
            break
        try:
            result = check()
        except Exception as error:
            result = crash(error)
        yield Done(
            kind=kind, seed=seed, block=number, case=case, label=label, result=result
        )
    # A process can map only so many programs.
    jax.clear_caches()


def crash(error: Exception) -> Result:
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = " ".join(str(error).split())[:300]
    at = f"{Path(place.filename).name}:{place.lineno}"
    return Result([f"crash: {type(error).__name__} at {at}: {text}"], {})


def lines(done: Done) -> list[str]:
    where = f"--only {done.kind} --seed {done.seed} --block {done.block}"
    return [
        f"{done.kind}  {where} (case {done.case})  {done.label}: {finding}"
        for finding in done.result.findings
    ]


def table(all_done: list[Done]) -> list[dict[str, Any]]:
    """A row for each label: cases, findings, and the largest of each measure."""
    groups = collections.defaultdict(list)
    for done in all_done:
        groups[done.kind, done.label].append(done.result)
    rows = []
    for (kind, label), results in groups.items():
        worst: dict[str, float] = {}
        for result in results:
            for name, x in result.measures.items():
                worst[name] = max(worst.get(name, -np.inf), float(x))
        found = sum(len(result.findings) for result in results)
        row = dict(kind=kind, label=label, cases=len(results), findings=found)
        rows.append(row | dict(worst=worst))
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    for row in sorted(rows, key=lambda row: (row["kind"], row["label"])):
        worst = "  ".join(f"{name} {x:.1e}" for name, x in row["worst"].items())
        count = f"{row['cases']:5d} cases {row['findings']:3d} findings"
        print(f"{row['kind']:9s} {row['label']:44s}{count}  {worst}")


def run(
    seed: int, seconds: float, kinds: tuple[str, ...], number: int | None, path: Path
) -> list[Done]:
    """Runs blocks, always of the kind with the least time so far, and saves each."""
    used, next_block = dict.fromkeys(kinds, 0.0), dict.fromkeys(kinds, number or 0)
    all_done: list[Done] = []
    begin = time.monotonic()
    while True:
        kind = min(kinds, key=lambda kind: used[kind])
        start = time.monotonic()
        for done in block(kind, seed, next_block[kind]):
            all_done.append(done)
            for line in lines(done):
                print(line, flush=True)
        took = time.monotonic() - start
        used[kind] += took
        print(f"{kind}, block {next_block[kind]}: {took:.0f} s", flush=True)
        if number is None:
            save(all_done, seed, path)
        next_block[kind] += 1
        if number is not None or time.monotonic() - begin > seconds:
            return all_done


def save(all_done: list[Done], seed: int, path: Path) -> None:
    """Keeps the findings of earlier runs with other seeds and kinds."""
    old = json.loads(path.read_text()) if path.exists() else []
    ran = {(done.kind, seed) for done in all_done}
    kept = [entry for entry in old if (entry["kind"], entry["seed"]) not in ran]
    for kind in sorted({done.kind for done in all_done}):
        of_kind = [done for done in all_done if done.kind == kind]
        found = [line for done in of_kind for line in lines(done)]
        counted = dict(kind=kind, seed=seed, cases=len(of_kind), findings=found)
        kept.append(counted | dict(rows=table(of_kind)))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(kept, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--only", choices=KINDS)
    parser.add_argument("--block", type=int, help="this block alone; nothing is saved")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    asked = parser.parse_args()
    os.environ["XLA_FLAGS"] = f"{FLAGS} {os.environ.get('XLA_FLAGS', '')}".strip()
    jax.config.update("jax_enable_x64", True)
    kinds = (asked.only,) if asked.only else KINDS
    path = asked.out / "fuzz.json"
    show(table(run(asked.seed, 60 * asked.minutes, kinds, asked.block, path)))


if __name__ == "__main__":
    main()
