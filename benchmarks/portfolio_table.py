"""The table and the picture of `portfolio.py`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any


Record = dict[str, Any]
_HEAD = (
    "work", "scheme", "a step, us", "EXUDYN, us", "ratio", "others, us", "corrections",
    "a call, ms", "first call, s", "gradient / run", "its first call, s", "memory, MB",
    "error, m", "EXUDYN's", "energy",
)  # fmt: skip


def table(found: Record) -> str:
    """Markdown: a row for each motion, and below it why it misses its aims."""
    lines = [_line(_HEAD), _line(["---"] * len(_HEAD))]
    lines += [_line(_cells(row)) for row in found["rows"]]
    misses = [
        f"- `{row['work']}`: {miss}" for row in found["rows"] for miss in _misses(row)
    ]
    if misses:
        lines += ["", "What misses its aim, and why:", "", *misses]
    if found["scripts"]:
        lines += ["", *map(_script, found["scripts"])]
    return "\n".join(lines) + "\n"


def _line(cells: Any) -> str:
    return f"| {' | '.join(cells)} |"


def _cells(row: Record) -> Iterator[str]:
    """Aims are in brackets."""
    bars, peers = row["bars"], row["peers"]
    exudyn, gradient = peers.get("exudyn", {}), row.get("gradient", {})
    yield row["work"] + (f" (h = {row['h']:g})" if row["h"] != 1e-3 else "")
    yield f"`{row['scheme']}`"
    if row.get("failure"):
        yield row["failure"].split(".")[0]
    else:
        yield _with_bar(row.get("us_per_step"), bars["us"])
    yield "fails" if exudyn.get("failure") else _number(exudyn.get("us_per_step"))
    yield _with_bar(exudyn.get("ratio"), bars["ratio"])
    others = (name for name in peers if name != "exudyn" and "us_per_step" in peers[name])
    yield ", ".join(f"{_NAMES[k]} {_number(peers[k]['us_per_step'])}" for k in others)
    yield _number(row.get("corrections"))
    yield _number(row.get("call_ms"))
    is_first = "first_call_s" in row
    yield _with_bar(row["first_call_s"], bars["first_call"]) if is_first else ""
    yield _with_bar(gradient.get("ratio"), bars["gradient_ratio"]) if gradient else ""
    first = gradient.get("first_call_s")
    yield _with_bar(first, bars["gradient_first_call"]) if gradient else ""
    yield _with_bar(row["peak_mb"], bars["peak_mb"]) if is_first else ""
    yield _small(row.get("error"))
    yield _small(exudyn.get("error"))
    yield "" if row["scheme"].startswith("Rattle") else _small(row.get("balance"))


_NAMES = {"mujoco": "MuJoCo", "diffrax": "diffrax"}


def _with_bar(value: float | None, bar: float | None) -> str:
    text = _number(value)
    if value is None or bar is None:
        return text
    return f"{text} [{bar:g}]" if value <= bar else f"**{text}** [{bar:g}]"


def _number(value: float | None) -> str:
    """Three digits."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _small(value: float | None) -> str:
    return "" if value is None else f"{value:.0e}"


def _misses(row: Record) -> Iterator[str]:
    """A line for each aim that is missed, with what limits it."""
    bars, gradient = row["bars"], row.get("gradient", {})
    if row.get("failure"):
        yield f"fails: {row['failure']}"
        return
    ratio, us = row["peers"].get("exudyn", {}).get("ratio"), row["us_per_step"]
    is_slow = _above(ratio, bars["ratio"]) or _above(us, bars["us"])
    if is_slow:
        each = us / max(row["corrections"], 1e-9)
        obstacles = row["obstacles"]
        way = (
            f"no single function ({'; '.join(obstacles)})" if obstacles else "one function"
        )
        yield (
            f"time: {row['corrections']:.1f} corrections of {_number(each)} us, "
            f"{row['unknowns']} unknowns, {row['operations']} operations an evaluation; "
            f"{row['method']}; {row['matrices']}; {way}"
        )
    if "first_call_s" in row and _above(row["first_call_s"], bars["first_call"]):
        yield f"first call: {_parts(row)}"
    if _above(gradient.get("ratio"), bars["gradient_ratio"]):
        yield f"gradient: {_number(gradient['us_per_step'])} us a step"
    if _above(gradient.get("first_call_s"), bars["gradient_first_call"]):
        yield f"first call of the gradient: {_parts(gradient)}"
    if _above(row.get("peak_mb"), bars["peak_mb"]):
        yield f"memory: {row['before_mb']:.0f} MB before the first call"
    if gradient.get("failure"):
        yield f"gradient: {gradient['failure']}"
    if _above(gradient.get("off"), 1e-9):
        yield f"gradient: differs from difference quotients by {gradient['off']:.0e}"


def _above(value: float | None, bar: float | None) -> bool:
    # A gradient that is NaN is above every bar.
    return value is not None and bar is not None and not value <= bar


def _parts(record: Record) -> str:
    names = dict(trace_s="tracing", lower_s="lowering", xla_s="XLA", execute_s="the run")
    return ", ".join(f"{name} {record[key]:.1f} s" for key, name in names.items())


def _script(row: Record) -> str:
    what = "gradient" if row["program"].endswith("gradient") else "result"
    if "seconds" not in row:
        return f"`{row['work']}`: {row['failure']}"
    took = f"{_with_bar(row['seconds'], row['bar'])} s, {row['peak_mb']:.0f} MB"
    return f"`{row['work']}`, from `import` to the first {what}: {took}"


def draw(rows: list[Record], path: Path) -> None:
    """The ratio of times to EXUDYN, and the seconds of the first calls, of each work."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    panels = (
        ("time of a step / EXUDYN's", "ratio", _ratio),
        ("first call, s", "first_call", lambda row: row.get("first_call_s")),
        (
            "gradient / run",
            "gradient_ratio",
            lambda row: row.get("gradient", {}).get("ratio"),
        ),
    )
    figure, axes = plt.subplots(1, 3, figsize=(13, 0.22 * len(rows) + 1), sharey=True)
    names = [row["work"] for row in rows]
    for axis, (label, bar, value) in zip(axes, panels, strict=True):
        for place, row in enumerate(rows):
            found, aim = value(row), row["bars"][bar]
            if found is None:
                continue
            colour = "C3" if _above(found, aim) else "C0"
            axis.plot(found, place, "o", color=colour)
            if aim is not None:
                axis.plot(aim, place, "|k")
        axis.set(xlabel=label, xscale="log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(axis="y", linewidth=0.3)
    axes[0].set_yticks(range(len(names)), names, fontsize=7)
    axes[0].set_ylim(len(names), -1)
    figure.suptitle("dots: measured, red above the aim; bars: aims", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def _ratio(row: Record) -> float | None:
    return row["peers"].get("exudyn", {}).get("ratio")
