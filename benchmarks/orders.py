"""Measured orders: every scheme with repeatedly halved steps against references.

    python benchmarks/orders.py [--quick] [--out FOLDER]

The references are explicit Runge-Kutta solutions in minimal coordinates. Errors are the
largest over q and over v at four times. Orders are slopes over the halvings above the
round-off plateau; a row has none unless there are two, and none if a run failed.
Writes orders.csv, orders.json and orders.png.
"""

import argparse
import sys
import time
from concurrent.futures import as_completed, ThreadPoolExecutor
from pathlib import Path

import jax


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Measure the orders of accuracy of all schemes. Print one table, "
        "and write it with a picture."
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(__file__).parent / "results",
        metavar="FOLDER",
        help="where to write orders.csv, .json and .png (default: benchmarks/results)",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="two problems instead of five, two halvings instead of three, and no "
        "compositions above order 4",
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    return options


def main(arguments: list[str] | None = None) -> None:
    begin = time.perf_counter()
    options = _parse(arguments)
    jax.config.update("jax_enable_x64", True)
    import order_report
    from catalogue import CASES, methods, QUICK_CASES
    from convergence import measure, Row
    from references import solve

    levels = 3 if options.quick else 4
    tasks = []
    for case in CASES:
        if options.quick and case.name not in QUICK_CASES:
            continue
        problem = case.problem()
        reference = solve(case.minimal, problem.args, case.times)
        groups = [g for g in methods(case) if not options.quick or g[0].expected <= 4]
        tasks += [(case, problem, group, reference, levels) for group in groups]
    # The slowest programs to compile go first, so that neither thread ends up alone.
    order = sorted(range(len(tasks)), key=lambda k: -tasks[k][1].start.q.size)
    rows: dict[int, list[Row]] = {}
    with ThreadPoolExecutor(2) as pool:
        futures = {pool.submit(measure, *tasks[k]): k for k in order}
        for future in as_completed(futures):
            k = futures[future]
            rows[k] = future.result()
            case, method = rows[k][-1].case, rows[k][-1].method
            done = f"{len(rows)} of {len(tasks)}"
            print(f"{done}: {case.name}, {method.name}", file=sys.stderr)
    table = [row for k in sorted(rows) for row in rows[k]]
    print(order_report.as_text(table))
    seconds = time.perf_counter() - begin
    order_report.write_csv(table, options.out / "orders.csv")
    order_report.write_json(table, options.out / "orders.json", seconds)
    order_report.write_picture(table, options.out / "orders.png")
    print(
        f"\n{sum(len(row.runs) for row in table)} runs in {seconds:.0f} s, compilation "
        f"included. Wrote orders.csv, orders.json and orders.png to {options.out}/"
    )


if __name__ == "__main__":
    main()
