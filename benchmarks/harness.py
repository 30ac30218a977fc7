"""What the benchmarks share: one core, processes of their own, medians of turns.

A benchmark starts itself once for each setting of XLA, with `--mode`, because XLA reads
its settings only once; the child prints its rows as the last line of its output.
"""

import argparse
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

import enerjax as ej


Row = dict[str, Any]


def options(description: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="less work, rougher times")
    parser.add_argument("--mode", choices=["default", "fast"], help=argparse.SUPPRESS)
    return parser.parse_args()


def pin() -> None:
    """Keep to one core: times of two are not comparable."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def enter(mode: str) -> None:
    """Set up a child: before the first array is made."""
    if mode == "fast":
        ej.enable_fast_loops()
    jax.config.update("jax_enable_x64", True)


def hand_over(rows: list[Row]) -> None:
    print(json.dumps(rows))


def children(script: str, quick: bool) -> list[Row]:
    """The rows of a child for each setting; a GPU knows only one."""
    rows: list[Row] = []
    for mode in ("default", "fast"):
        command = [sys.executable, script, "--mode", mode, *(["--quick"] if quick else [])]
        out = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        *messages, data = out.stdout.splitlines()
        print("\n".join(messages)) if messages else None
        rows += [dict(mode=mode) | row for row in json.loads(data)]
        if any(row["platform"] != "cpu" for row in rows):
            break
    return rows


def device() -> Row:
    first = jax.devices()[0]
    return dict(platform=first.platform, device=first.device_kind)


def compiled(fn: Callable, *args: Any) -> tuple[Any, float]:
    """The program of `fn`, and the seconds that it took to compile."""
    begin = time.perf_counter()
    program = jax.jit(fn).lower(*args).compile()
    return program, time.perf_counter() - begin


def medians(programs: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
    """Seconds of each program, run in turn: a busy moment of the machine meets them all."""
    times: list[list[float]] = [[] for _ in programs]
    for _ in range(repeats):
        for program, record in zip(programs, times, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(program())
            record.append(time.perf_counter() - begin)
    return [statistics.median(record) for record in times]


def write(rows: list[Row], out: Path, name: str) -> Path:
    """Saves the rows; where the picture belongs."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(rows, indent=1))
    return out / f"{name}.png"
