"""Tables of the rows of a run: text files, `pandas` and `xarray`."""

import csv
import dataclasses
import io
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import ArrayLike

from .._files import write_whole
from .._results import names_of
from .._system import Names, State
from .reached import ReachedRows
from .solution import Solution


# Arrays by name, with the rows along the first axis.
Columns: TypeAlias = dict[str, np.ndarray]


def table(solution: Solution, columns: Mapping[str, ArrayLike] | None) -> Columns:
    """One array `(rows,)` for each column of a table of the reached rows."""
    reached, labels = ReachedRows(solution), _labels(solution)
    found = dict(t=np.asarray(solution.ts))
    if columns is None:
        found |= _of_states(solution) | dict(multiplier=np.asarray(solution.multipliers))
    else:
        found |= {name: np.asarray(x) for name, x in columns.items()}
    found |= _of_audit(solution) | _of_steps(solution)
    for name, x in found.items():
        if x.shape[:1] != solution.ts.shape:
            raise ValueError(
                f"The column `{name}` has the shape {x.shape}, and the run has "
                f"{solution.ts.size} rows: the first axis must be that of the rows."
            )
    flat = _flat(found, labels)
    return {name: reached(x) for name, x in flat}


def _labels(solution: Solution) -> dict[str, list[str]]:
    """The names along the second axis of arrays."""
    names, audit = solution.names or Names(), solution.audit
    number = lambda kind, x: [f"{kind}{k}" for k in range(x.shape[-1])]
    rows = list(names.constraints or number("", solution.multipliers))
    num_rates = audit.constraint_rate.shape[-1]
    # Nonholonomic constraints have rates only; relations between coordinates follow them.
    holonomic = num_rates - (len(rows) - audit.constraint.shape[-1])
    found = dict(
        multiplier=rows,
        constraint=rows[:holonomic] + rows[num_rates:],
        constraint_rate=rows[:num_rates],
        momentum=number("", audit.momentum),
    )
    if isinstance(solution.ys, State):
        found["q"] = list(names.coordinates or number("q", solution.ys.q))
        found["v"] = list(names.velocities or number("v", solution.ys.v))
    return found


def _of_states(solution: Solution) -> Columns:
    if isinstance(solution.ys, State):
        return dict(q=np.asarray(solution.ys.q), v=np.asarray(solution.ys.v))
    return _named(solution.ys, "y")


def _of_audit(solution: Solution) -> Columns:
    """The entries of the audit, with those that follow from others."""
    audit = solution.audit
    names = [field.name for field in dataclasses.fields(audit)]
    return {name: np.asarray(getattr(audit, name)) for name in [*names, "energy", "leak"]}


def _of_steps(solution: Solution) -> Columns:
    """What belongs to the steps before a row. There are none before the start."""
    stats = solution.stats
    names = ("newton_iterations", "residual", "halvings", "local_error")
    found = {name: np.asarray(getattr(stats, name)) for name in names}
    found |= _named(solution.details, "details")

    def with_start(x: np.ndarray) -> np.ndarray:
        none = np.zeros_like(x[:1], shape=(1, *x.shape[1:]))
        if x.dtype.kind == "f":
            none = none + np.nan
        return np.concatenate([none, x]) if len(x) < solution.ts.size else x

    return {name: with_start(x) for name, x in found.items()}


def _named(tree: Any, whole: str) -> Columns:
    """The arrays of a tree by their places; one that is alone is called `whole`."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator=".")
    return {name(path) or whole: np.asarray(x) for path, x in found}


def _flat(
    columns: Columns, labels: Mapping[str, list[str]]
) -> Iterator[tuple[str, np.ndarray]]:
    """Columns without further axes; their names contain labels or indices."""
    for name, x in columns.items():
        if name in ("q", "v") and name in labels:
            yield from zip(labels[name], x.T, strict=True)
        elif name in labels:
            keys = (f"{name}.{label}" for label in labels[name])
            yield from zip(keys, x.T, strict=True)
        else:
            for place in np.ndindex(x.shape[1:]):
                index = f"[{', '.join(map(str, place))}]" if place else ""
                yield name + index, x[:, *place]


def write_csv(path: str | os.PathLike, columns: Columns) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(columns)
    lines = np.stack([x.astype(float) for x in columns.values()], axis=1)
    np.savetxt(text, lines, fmt="%.17g", delimiter=",")
    write_whole(Path(path), lambda file: file.write(text.getvalue().encode()))


def data_frame(columns: Columns) -> Any:
    try:
        import pandas  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise _missing("to_pandas", "pandas") from error
    index = pandas.Index(columns["t"], name="t")
    rest = {name: x for name, x in columns.items() if name != "t"}
    return pandas.DataFrame(rest, index=index)


def dataset(solution: Solution) -> Any:
    try:
        import xarray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise _missing("to_xarray", "xarray") from error
    reached, labels = ReachedRows(solution), _labels(solution)
    has_position = labels["constraint"] == labels["multiplier"]
    dims = dict(
        q="coordinate",
        v="velocity",
        multiplier="multiplier",
        multipliers="multiplier",
        constraint="multiplier" if has_position else "constraint",
        constraint_rate="joint",
        momentum="symmetry",
    )
    values = _of_states(solution) | dict(multipliers=np.asarray(solution.multipliers))
    values |= _of_audit(solution) | _of_steps(solution)
    variables = {}
    for name, x in values.items():
        known = [dims[name]] if name in dims else []
        own = [f"{name}_{k}" for k in range(x.ndim - 1 - len(known))]
        variables[name] = (["t", *known, *own], reached(x))
    coordinates = {dims[name]: np.array(names, str) for name, names in labels.items()}
    stats = solution.stats
    about = dict(
        result=names_of(solution.result),
        completed_steps=int(stats.completed_steps),
        phase_error=float(solution.phase_error),
    )
    if stats.rejected_steps is not None:
        about["rejected_steps"] = int(stats.rejected_steps)
    coordinates["t"] = reached.ts
    return xarray.Dataset(variables, coordinates, about)


def _missing(method: str, library: str) -> ImportError:
    return ImportError(
        f"`{method}` needs {library}, which is part of the extra `tables`: "
        'python -m pip install "enerjax[tables]"'
    )
