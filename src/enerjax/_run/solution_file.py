"""Solutions in files."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._files import read_arrays, write_arrays
from .._programs import is_known
from .._results import from_names, names_of, RESULTS
from .._system import Names, State
from .audit import Audit
from .events import Events
from .solution import Continuation, Solution, Statistics


FORMAT = "enerjax solution"
# To be raised with every change by which older versions would misread a file.
VERSION = 1
_HEADER = "header"
_STORED = Audit, Continuation, Events, Names, Solution, State, Statistics
_MODULES = {cls.__name__: cls for cls in _STORED}


def save(path: str | os.PathLike, solution: Solution) -> None:
    """Write a solution to one file, from which `load` restores it.

    The file is an archive of NumPy, which `numpy.load` opens too. Its arrays are named
    after the fields of the solution: `ts`, `ys.q`, `ys.v`, `multipliers`, `audit.kinetic`,
    `stats.newton_iterations`, and so on. The array `header` is a text in JSON, as bytes,
    with the version of the format. There are no Python objects in the file. It is written
    completely or not at all.

    **Arguments:**

    - `path`: the name of the file; by convention it ends with `.npz`.
    - `solution`: of a run, or of a batch of runs. What `SaveAt(fn=...)` and third-party
      schemes return must consist of arrays, dictionaries with names as keys, lists and
      tuples.

    **Raises:** `TypeError` for anything else, and for traced solutions.
    """
    if not isinstance(solution, Solution):
        raise TypeError(f"`save` takes a `Solution`, got {type(solution).__name__}.")
    if not is_known(solution):
        raise TypeError(
            "`save` was called inside of `jit`, `vmap` or `grad`, where the numbers of the "
            "solution are not known. Call it with the result, outside."
        )
    arrays: dict[str, np.ndarray] = {}
    header = dict(format=FORMAT, version=VERSION, solution=_written(solution, "", arrays))
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_arrays(Path(path), {_HEADER: text} | arrays)


def load(path: str | os.PathLike) -> Solution:
    """The solution that `save`, or `simulate(..., checkpoint=path)`, has written.

    **Raises:** `ValueError` if the file is damaged, is no solution, or was written by a
    newer version of this library, and if it has numbers in double precision which JAX would
    round. `FileNotFoundError` if there is no such file.
    """
    arrays = read_arrays(Path(path)) or {}
    header = _header(arrays)
    if header.get("format") != FORMAT:
        raise ValueError(
            f"The file {path} is not a solution that `enerjax.save` has written, or it is "
            "damaged or incomplete. (`save` and checkpoints replace a file only when the "
            "new one is complete: check the disk, or how the file was copied.)"
        )
    if header["version"] > VERSION:
        raise ValueError(
            f"The file {path} has version {header['version']} of the format, and this "
            f"enerjax knows versions up to {VERSION}. Upgrade enerjax to read it."
        )
    if arrays["ts"].dtype == np.float64 and jnp.asarray(0.0).dtype != np.float64:
        raise ValueError(
            f"The file {path} has numbers in double precision, which JAX would round. Call "
            '`jax.config.update("jax_enable_x64", True)` first.'
        )
    return _read(header["solution"], arrays)


def _header(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    try:
        return dict(json.loads(arrays[_HEADER].tobytes()))
    except (KeyError, ValueError, TypeError):
        return {}


def _written(tree: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """A description of a tree for the header. Its arrays are added to `arrays`."""
    inner = lambda key, part: _written(part, f"{name}.{key}" if name else key, arrays)
    if tree is None:
        return None
    if isinstance(tree, str):
        return dict(text=tree)
    if isinstance(tree, RESULTS):
        return dict(result=names_of(tree))
    if type(tree) in _MODULES.values():
        fields = {key: inner(key, part) for key, part in vars(tree).items()}
        return dict(module=type(tree).__name__, fields=fields)
    if type(tree) is dict and all(isinstance(key, str) for key in tree):
        return dict(dict={key: inner(key, part) for key, part in tree.items()})
    if type(tree) in (list, tuple):
        parts = [inner(str(k), part) for k, part in enumerate(tree)]
        return {type(tree).__name__: parts}
    if isinstance(tree, jax.Array | np.ndarray | np.generic) and tree.dtype.kind in "biufc":
        while name in arrays:  # keys of dictionaries can contain dots
            name += "_"
        arrays[name] = np.asarray(tree)
        return dict(array=name)
    raise TypeError(
        f"`{name}` is of type {type(tree).__name__}, which cannot be written to a file "
        "without code. Return arrays, dictionaries with names as keys, lists or tuples "
        "from the function in `SaveAt(fn=...)`."
    )


def _read(about: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The inverse of `_written`."""
    if about is None:
        return None
    ((kind, value), *others) = about.items()
    if kind == "text":
        return value
    if kind == "result":
        return from_names(value)
    if kind == "array":
        return jnp.asarray(arrays[value])
    if kind == "dict":
        return {key: _read(part, arrays) for key, part in value.items()}
    if kind in ("list", "tuple"):
        parts = [_read(part, arrays) for part in value]
        return parts if kind == "list" else tuple(parts)
    (_, of_fields), *_ = others
    fields = {key: _read(part, arrays) for key, part in of_fields.items()}
    if value == "Audit" and "impact" not in fields:  # written before there were impacts
        fields["impact"] = 0 * fields["dissipated"]
    return _MODULES[value](**fields)
