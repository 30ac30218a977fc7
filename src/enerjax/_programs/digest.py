"""Checksums of arrays, and of programs: one word, which is the same in every process."""

import enum
import hashlib
import types
import weakref
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def checksum(arrays: Iterable[Any]) -> str:
    """One word for the content of some arrays."""
    word = hashlib.sha256()
    for array in arrays:
        array = np.ascontiguousarray(array)
        word.update(repr((array.shape, str(array.dtype))).encode())
        word.update(array.tobytes())
    return word.hexdigest()


# A program that is called again need not be read again.
_known: weakref.WeakKeyDictionary[ClosedJaxpr, str] = weakref.WeakKeyDictionary()


def digest(traced: ClosedJaxpr) -> str:
    """One word for a program, which is the same in every process.

    The text of the program does not suffice: it contains addresses of functions, but no
    values of constants.
    """
    if traced not in _known:
        word = hashlib.sha256()
        _read(traced.jaxpr, traced.consts, lambda *x: word.update(repr(x).encode()))
        _known[traced] = word.hexdigest()
    return _known[traced]


def _read(jaxpr: Jaxpr, consts: Any, tell: Callable) -> None:
    names: dict[Any, int] = {}
    name = lambda atom: (
        (np.asarray(atom.val).tolist(), str(atom.aval))
        if isinstance(atom, Literal)
        else names.setdefault(atom, len(names))
    )
    for const in consts:
        tell(checksum([const]))
    tell([(name(x), str(x.aval)) for x in (*jaxpr.constvars, *jaxpr.invars)])
    for eqn in jaxpr.eqns:
        tell(eqn.primitive.name, [name(x) for x in eqn.invars])
        for key in sorted(eqn.params):
            tell(key)
            _read_parameter(eqn.params[key], tell)
        tell([(name(x), str(x.aval)) for x in eqn.outvars])
    tell([name(x) for x in jaxpr.outvars])


def _read_parameter(value: Any, tell: Callable) -> None:
    """Reads a parameter of an equation; of an object of unknown type only the type."""
    tell(type(value).__qualname__)
    if isinstance(value, ClosedJaxpr):
        _read(value.jaxpr, value.consts, tell)
    elif isinstance(value, Jaxpr):
        _read(value, (), tell)
    elif isinstance(value, tuple | list):
        for part in value:
            _read_parameter(part, tell)
    elif isinstance(value, dict):
        _read_parameter(list(value.items()), tell)
    elif isinstance(value, set | frozenset):
        tell(sorted(map(repr, value)))
    elif isinstance(value, enum.Enum):
        tell(value.name)
    elif isinstance(value, bool | int | float | complex | str | bytes | np.dtype):
        tell(value)
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        tell(checksum([value]))
    elif isinstance(value, types.FunctionType):
        _read_function(value, tell)
    elif isinstance(getattr(value, "jaxpr", None), Jaxpr):
        # A program with further attributes, such as indices that are known.
        _read_parameter({k: x for k, x in vars(value).items() if k[0] != "_"}, tell)
    elif callable(getattr(value, "callback_func", None)):
        _read_parameter(value.callback_func, tell)


def _read_function(fn: types.FunctionType, tell: Callable) -> None:
    """Reads a Python function, such as that of `jax.pure_callback`: its code, and the
    numbers and strings that it closes over."""
    _read_code(fn.__code__, tell)
    cells = (cell.cell_contents for cell in fn.__closure__ or ())
    for value in (*(fn.__defaults__ or ()), *cells):
        if isinstance(value, bool | int | float | complex | str | np.ndarray | jax.Array):
            _read_parameter(value, tell)


def _read_code(code: types.CodeType, tell: Callable) -> None:
    tell(code.co_code, code.co_names, code.co_varnames)
    for const in code.co_consts:
        if isinstance(const, types.CodeType):
            _read_code(const, tell)
        else:
            _read_parameter(const, tell)
