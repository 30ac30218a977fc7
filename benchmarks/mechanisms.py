"""Comparison with published motions of mechanisms and particles, for three step lengths.

    python benchmarks/mechanisms.py [--quick] [--out FOLDER]

Every problem of the package whose motion is published or known exactly is compared with
these values (`data/mechanisms.json` names their sources). Errors are the largest over all
published times; orders are those of the last halving. Energies are relative to the largest
kinetic energy: `balance` is the change that the work of drives and the dissipation of the
scheme do not explain. Writes mechanisms.csv and mechanisms.png.
"""

import argparse
import dataclasses
import sys
import time
from concurrent.futures import as_completed, ThreadPoolExecutor
from itertools import groupby
from pathlib import Path

import harness
import jax
import numpy as np
from matplotlib.figure import Figure

import enerjax as ej


@dataclasses.dataclass(frozen=True)
class Row:
    """A scheme on a problem at one step; the errors are NaN if it failed."""

    problem: str
    scheme: str
    h: float
    end: float
    error_q: float
    error_v: float
    order_q: float
    order_v: float
    balance: float
    dissipated: float
    constraint: float
    constraint_rate: float
    newton: float


def measure(case, problem, name: str, levels: int) -> list[Row]:
    from mechanism_cases import SCHEMES

    rows: list[Row] = []
    for level in range(levels):
        row = _run(case, problem, name, SCHEMES[name][0], 2**level)
        if rows:
            order_q, order_v = (
                float(np.log2(getattr(rows[-1], x) / getattr(row, x)))
                for x in ("error_q", "error_v")
            )
            row = dataclasses.replace(row, order_q=order_q, order_v=order_v)
        rows.append(row)
    return rows


def _run(case, problem, name: str, scheme: ej.AbstractScheme, finer: int) -> Row:
    """In calls of the same number of steps, so that all share one program."""
    published = case.published()
    system, state, args = problem
    end = published[-1][0]
    h, calls = case.block / (case.steps * finer), round(end / case.block) * finer
    errors, parts, kinetic, failed = [], [], 0.0, False
    for call in range(calls):
        run = ej.simulate(
            system,
            scheme,
            state,
            args,
            h=h,
            num_steps=case.steps,
            t0=call * case.steps * h,
            throw=False,
        )
        failed = failed or bool(run.result != ej.RESULTS.successful)
        audit = run.audit
        kinetic = max(kinetic, float(np.max(audit.kinetic)))
        explained = audit.work + audit.drive_work - audit.dissipated
        parts.append(
            [
                float(np.sum(np.diff(audit.energy) - explained[1:])),
                float(np.sum(audit.dissipated)),
                _largest(audit.constraint),
                _largest(audit.constraint_rate),
                float(np.mean(run.stats.newton_iterations)),
            ]
        )
        q, v = np.asarray(run.ys.q[-1]), np.asarray(run.ys.v[-1])
        state = ej.State(q, v)
        for t, x, xdot in published:
            if abs(t - (call + 1) * case.steps * h) < 0.5 * h:
                now, rate = case.observe(q, v, x)
                errors.append([np.max(np.abs(now - x)), np.max(np.abs(rate - xdot))])
    leaks, lost, constraint, rate, newton = np.array(parts).T
    error_q, error_v = np.max(errors, axis=0) if not failed else (np.nan, np.nan)
    return Row(
        problem=case.name,
        scheme=name,
        h=h,
        end=end,
        error_q=error_q,
        error_v=error_v,
        order_q=np.nan,
        order_v=np.nan,
        balance=np.max(np.abs(np.cumsum(leaks))) / kinetic,
        dissipated=np.sum(lost) / kinetic,
        constraint=np.max(constraint),
        constraint_rate=np.max(rate),
        newton=np.mean(newton),
    )


def _largest(x: jax.Array) -> float:
    return float(np.max(np.abs(x), initial=0.0))


def show(rows: list[Row]) -> None:
    line = "{:32} {:>9} {:>9} {:>9} {:>6} {:>6} {:>9} {:>9} {:>9} {:>9} {:>7}"
    header = line.format(
        "scheme", "h", "error q", "error v", "order", "(v)", "balance", "decay", "|Phi|",
        "|psi|", "Newton",
    )  # fmt: skip
    for problem, group in groupby(rows, lambda row: row.problem):
        group = list(group)
        print(f"\n{problem}, to t = {group[0].end:.6g}\n{header}")
        for r in group:
            small = [f"{x:.1e}" for x in (r.balance, r.dissipated)]
            held = [f"{x:.1e}" for x in (r.constraint, r.constraint_rate)]
            orders = [f"{x:.2f}" for x in (r.order_q, r.order_v)]
            print(
                line.format(
                    r.scheme, f"{r.h:.3g}", f"{r.error_q:.1e}", f"{r.error_v:.1e}",
                    *orders, *small, *held, f"{r.newton:.2f}",
                )
            )  # fmt: skip


def draw(rows: list[Row], path: Path) -> None:
    """Error in q against h, a panel for each problem."""
    groups = [(name, list(g)) for name, g in groupby(rows, lambda row: row.problem)]
    columns = min(4, len(groups))
    lines = -(-len(groups) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.9 * lines), layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, (name, group) in zip(panels, groups, strict=False):
        for k, (scheme, runs) in enumerate(groupby(group, lambda row: row.scheme)):
            h, error = np.array([(row.h, row.error_q) for row in runs]).T
            style = dict(color=f"C{k}", marker="os^"[k], markersize=4)
            axes.loglog(h, error, label=scheme, **style)
        axes.set_title(f"{name}, t = {group[0].end:.4g}", fontsize=9)
        axes.set_xlabel("h")
        axes.grid(which="major", linewidth=0.3)
    for axes in panels[len(groups) :]:
        axes.axis("off")
    panels[0].set_ylabel("largest error in q")
    panels[0].legend(fontsize="xx-small")
    figure.savefig(path, dpi=130)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="three problems, two steps")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    from mechanism_cases import CASES, QUICK, SCHEMES

    begin = time.perf_counter()
    cases = [case for case in CASES if not options.quick or case.name in QUICK]
    problems = [(case, case.problem()) for case in cases]
    levels = 2 if options.quick else 3
    found: dict[tuple[int, str], list[Row]] = {}
    with ThreadPoolExecutor(2) as pool:
        futures = {
            pool.submit(measure, case, problem, name, levels): (k, name)
            for k, (case, problem) in enumerate(problems)
            for name in SCHEMES
        }
        for future in as_completed(futures):
            k, name = futures[future]
            found[k, name] = future.result()
            last = found[k, name][-1]
            message = f"{last.problem}, {name}: {last.error_q:.1e}, {last.order_q:.2f}"
            print(message, file=sys.stderr, flush=True)
    rows = [row for k in range(len(cases)) for name in SCHEMES for row in found[k, name]]
    show(rows)
    harness.write_csv(rows, options.out / "mechanisms.csv")
    draw(rows, options.out / "mechanisms.png")
    print(f"\n{len(rows)} runs in {time.perf_counter() - begin:.0f} s, with compilation.")


if __name__ == "__main__":
    main()
