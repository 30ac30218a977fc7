"""Checksums of arrays, and of programs: one word, which is the same in every process."""

import enum
import hashlib
import types
import weakref
from collections.abc import Iterable
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
        _known[traced] = _Reader(traced).word.hexdigest()
    return _known[traced]


def complete_digest(traced: ClosedJaxpr) -> str | None:
    """`digest(traced)` if it is that of this program alone.

    `None` if the program has constants without known numbers, such as traced values and
    random keys, or parameters of unknown types.
    """
    try:
        reader = _Reader(traced)
    except TypeError:
        # An array cannot be converted to one of NumPy.
        return None
    return None if reader.has_unknown else reader.word.hexdigest()


# Parameters of these types do not change the values of a program: where arrays are, and how
# to derive, transpose and batch it.
_WITHOUT_VALUES = frozenset(
    """
    AbstractMesh ClosedRule Mesh NamedSharding NoneType PyTreeDef SaveOnlyTheseNames
    UnspecifiedValue WrappedFun
    """.split()
)


class _Reader:
    """Reads a program into a word.

    `has_unknown` tells whether a parameter is of a type of which only the name is read.
    """

    def __init__(self, traced: ClosedJaxpr):
        self.word = hashlib.sha256()
        self.has_unknown = False
        self._read(traced.jaxpr, traced.consts)

    def _tell(self, *parts: Any) -> None:
        self.word.update(repr(parts).encode())

    def _read(self, jaxpr: Jaxpr, consts: Any) -> None:
        names: dict[Any, int] = {}
        types_of: dict[int, str] = {}

        def name(atom: Any) -> Any:
            if isinstance(atom, Literal):
                return np.asarray(atom.val).tolist(), str(atom.aval)
            return names.setdefault(atom, len(names))

        def typed(atom: Any) -> Any:
            # Many variables have one type, whose text takes longer to make.
            key = id(atom.aval)
            if key not in types_of:
                types_of[key] = str(atom.aval)
            return name(atom), types_of[key]

        for const in consts:
            self._tell(checksum([const]))
        self._tell(list(map(typed, (*jaxpr.constvars, *jaxpr.invars))), len(jaxpr.eqns))
        for eqn in jaxpr.eqns:
            self._tell(eqn.primitive.name, list(map(name, eqn.invars)))
            for key in sorted(eqn.params):
                self._tell(key)
                self._parameter(eqn.params[key])
            self._tell(list(map(typed, eqn.outvars)))
        self._tell(list(map(name, jaxpr.outvars)))

    def _parameter(self, value: Any) -> None:
        """Reads a parameter of an equation; of an object of unknown type only the type."""
        self._tell(type(value).__qualname__)
        if isinstance(value, ClosedJaxpr):
            self._read(value.jaxpr, value.consts)
        elif isinstance(value, Jaxpr):
            self._read(value, ())
        elif isinstance(value, tuple | list):
            self._tell(len(value))
            for part in value:
                self._parameter(part)
        elif isinstance(value, dict):
            self._parameter(list(value.items()))
        elif isinstance(value, set | frozenset):
            self._tell(sorted(map(repr, value)))
        elif isinstance(value, enum.Enum):
            self._tell(value.name)
        elif isinstance(value, bool | int | float | complex | str | bytes | np.dtype):
            self._tell(value)
        elif isinstance(value, np.ndarray | np.generic | jax.Array):
            self._tell(checksum([value]))
        elif isinstance(value, types.FunctionType):
            self._function(value)
        elif isinstance(getattr(value, "jaxpr", None), Jaxpr):
            # A program with known inputs.
            self._read(value.jaxpr, ())
            self._parameter(getattr(value, "known", ()))
        elif callable(getattr(value, "callback_func", None)):
            self._parameter(value.callback_func)
        elif isinstance(value, type):
            self._tell(value.__qualname__)
        elif type(value).__name__ not in _WITHOUT_VALUES:
            self.has_unknown = True

    def _function(self, fn: types.FunctionType) -> None:
        """Reads a Python function, such as that of `jax.pure_callback`: its code, and the
        numbers and strings that it closes over."""
        self._code(fn.__code__)
        cells = (cell.cell_contents for cell in fn.__closure__ or ())
        for value in (*(fn.__defaults__ or ()), *cells):
            if isinstance(
                value, bool | int | float | complex | str | np.ndarray | jax.Array
            ):
                self._parameter(value)

    def _code(self, code: types.CodeType) -> None:
        self._tell(code.co_code, code.co_names, code.co_varnames)
        for const in code.co_consts:
            if isinstance(const, types.CodeType):
                self._code(const)
            else:
                self._parameter(const)
