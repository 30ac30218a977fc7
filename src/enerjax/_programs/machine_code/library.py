"""Code for LLVM, compiled for this machine, as a function that XLA calls."""

import _thread
import ctypes
import functools
import hashlib
import sys
import threading
import time
import traceback
import zlib
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from . import addresses
from .code_on_disk import (
    Code,
    is_worth_keeping,
    keep_code,
    kept_code,
    kept_object,
    key_of,
)
from .compiler import loaded, object_of
from .emission import Emission
from .evaluation import Evaluation, rows_of_vectors
from .handler import texts_of
from .values import (
    Block,
    Cellar,
    CONSTANTS,
    dtype_of,
    Memory,
    type_name,
    Unsupported,
    Value,
)


class Function:
    """A program as a function of machine code.

    - `name`: the name under which XLA calls it.
    - `length`: the number of its operations.
    """

    def __init__(self, name: str, length: int):
        self.name, self.length = name, length


def compiled_function(jaxpr: Any, known: Sequence[np.ndarray | None]) -> Function:
    """The function of a program, of the inputs whose values are not known.

    Raises `Unsupported`.
    """
    key = key_of(jaxpr, known)
    code = None if key is None else kept_code(key)
    is_kept = code is not None
    if code is None:
        begin = time.perf_counter()
        code = _code_of(*graph_of(jaxpr, known))
        if key is not None and is_worth_keeping(time.perf_counter() - begin):
            keep_code(key, code)
            is_kept = True
    return Function(_library().added(code, is_kept), code.length)


def graph_of(jaxpr: Any, known: Sequence[np.ndarray | None]) -> tuple[Cellar, list, list]:
    """The graph of a program, with the cells of its inputs and outputs.

    Raises `Unsupported`.
    """
    evaluation = Evaluation(rows_of_vectors(jaxpr))
    cellar = evaluation.cellar
    variables = [*jaxpr.constvars, *jaxpr.invars]
    values: list[Value] = []
    inputs: list[tuple[str, int, int]] = []
    owner = Block(evaluation.graph.root, 0)
    for variable, value in zip(variables, known, strict=True):
        aval = variable.aval
        if value is not None:
            values.append(np.asarray(value, aval.dtype))
            continue
        dtype = type_name(aval.dtype)
        first = cellar.new(aval.size, owner)
        inputs.append((dtype, first, aval.size))
        values.append(
            Memory(dtype, (first + np.arange(aval.size)).reshape(aval.shape))
            if aval.size
            else np.zeros(aval.shape, aval.dtype)
        )
    count = len(jaxpr.constvars)
    try:
        outs = evaluation.outputs(jaxpr, values[:count], values[count:])
    except (AssertionError, LookupError, TypeError, ValueError) as error:
        # XLA may know what was not foreseen here.
        raise Unsupported(f"an error here, {error!r},") from error
    outs = [
        np.asarray(x, var.aval.dtype) if isinstance(x, np.ndarray) else x
        for x, var in zip(outs, jaxpr.outvars, strict=True)
    ]
    outputs = [
        (dtype_of(x), cellar.memory(x).places.ravel() if np.prod(x.shape) else None)
        for x in outs
    ]
    return cellar, inputs, outputs


def _code_of(cellar: Cellar, inputs: list, outputs: list) -> Code:
    emission = Emission(cellar, [places for _, places in outputs if places is not None])
    texts = texts_of(emission, inputs, outputs)
    constants = np.concatenate([np.zeros(0, np.int64), *cellar.constants])
    # Tables of distances have no constants' cells.
    tables = [emission.addresses(x) if np.any(x >= CONSTANTS) else x for x in cellar.tables]
    return Code(emission.length, texts, constants, tables)


class _Compiled:
    """Code in memory, and all that it refers to.

    Branches that are compiled when they are first taken are kept as text until then.
    """

    def __init__(self, code: Code, is_kept: bool):
        self._is_kept = is_kept
        self._branches = np.zeros(len(code.texts), np.uintp)
        self._compile = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int64)(self._branch)
        self._lock = threading.Lock()
        self._engines: list[Any] = []
        arrays = code.constants, self._branches, *code.tables
        self._arrays = [np.ascontiguousarray(x) for x in arrays]
        places = [x.ctypes.data for x in self._arrays]
        compile_branch = ctypes.cast(self._compile, ctypes.c_void_p).value
        assert compile_branch is not None
        places.insert(addresses.COMPILE, compile_branch)
        self._addresses = np.array(places, np.uintp)
        main, *late = code.texts
        self._late = {k: zlib.compress(x.encode(), 1) for k, x in enumerate(late)}
        self.address = self._address(main, "handler")

    def _branch(self, number: int) -> int:
        """Called by machine code, through which no exception can pass."""
        is_interrupted = False
        while True:
            try:
                address = self._compiled_branch(number)
                if is_interrupted:
                    # The interrupt comes again when Python runs its own code.
                    threading.Timer(0.01, _thread.interrupt_main).start()
                return address
            except KeyboardInterrupt:
                is_interrupted = True
            except BaseException:
                traceback.print_exc(file=sys.__stderr__)
                # The process ends.
                return 0

    def _compiled_branch(self, number: int) -> int:
        # Several threads may come to a branch at the same time.
        with self._lock:
            if number in self._late:
                text = zlib.decompress(self._late[number]).decode()
                self._branches[number] = self._address(text, "branch")
                del self._late[number]
            return int(self._branches[number])

    def _address(self, text: str, name: str) -> int:
        """Where the function of this name is."""
        # Only the code stays in memory, and not the text that it was made of.
        engine = loaded(kept_object(text) if self._is_kept else object_of(text))
        self._engines.append(engine)
        to = engine.get_global_value_address("addresses")
        ctypes.memmove(to, self._addresses.ctypes.data, self._addresses.nbytes)
        return engine.get_function_address(name)


class _Library:
    """The compiled functions of this process. They stay, because XLA may call them."""

    def __init__(self):
        self._kept: dict[str, _Compiled] = {}

    def added(self, code: Code, is_kept: bool) -> str:
        """The name under which XLA calls a program, which is compiled if it is new.

        If its text is kept on disk, so is its machine code.
        """
        digest = hashlib.sha256("".join(code.texts).encode())
        for x in (code.constants, *code.tables):
            digest.update(x.tobytes())
        name = f"enerjax_{digest.hexdigest()[:32]}"
        if name not in self._kept:
            compiled = self._kept[name] = _Compiled(code, is_kept)
            capsule = jax.ffi.pycapsule(ctypes.c_void_p(compiled.address))
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")
        return name


@functools.cache
def _library() -> _Library:
    return _Library()
