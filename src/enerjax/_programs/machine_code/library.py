"""Code for LLVM, compiled for this machine, as a function that XLA calls."""

import _thread
import contextlib
import ctypes
import functools
import hashlib
import re
import sys
import threading
import traceback
import zlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from .emission import Emission
from .evaluation import Evaluation, rows_of_vectors
from .loops import WIDTH
from .passes import PASSES
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


# The level at which LLVM optimises the code, from 0 to 3. At level 0 it compiles in a third
# of the time, and the code takes twice as long. Level 2 also orders the instructions after
# the registers are chosen, which takes a third longer, and its code is no faster.
OPTIMISATION = 1

# LLVM orders instructions and finds which of them use the same memory. The time that this
# takes grows faster than the length of a block. Texts of this many characters and more get
# another order, which needs few registers and is found in a third of the time. Short texts
# would compile no faster with it, and their code would be up to 5 % slower.
_LONG_TEXT = 2**20
_QUICK = (
    "-pre-RA-sched=list-burr",
    "-enable-misched=0",
    "-combiner-tokenfactor-inline-limit=64",
)
_USUAL = (
    "-pre-RA-sched=default",
    "-enable-misched=1",
    "-combiner-tokenfactor-inline-limit=2048",
)
# An option that LLVM does not know ends the process: these are known up to this version.
_KNOWN_LLVM = 22

_CODES = {"f8": "double", "f4": "float", "b1": "i8"} | {
    f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)
}


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
    return _function(*graph_of(jaxpr, known))


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


def _function(cellar: Cellar, inputs: list, outputs: list) -> Function:
    emission = Emission(cellar)
    copies = _copies(emission, inputs, outputs)
    constants = np.concatenate([np.zeros(0, np.int64), *cellar.constants])
    # Tables of distances have no constants' cells.
    tables = [emission.addresses(x) if np.any(x >= CONSTANTS) else x for x in cellar.tables]
    # One more, because kernels may read the cell behind a number.
    size = 8 * (cellar.num_constants + cellar.size + 1)
    handler = (PASSES if emission.has_passes else _WITHOUT_PASSES) + _HANDLER
    has_large_pages = sys.platform == "linux" and size >= _LARGE
    for key, value in {
        "LARGE_PAGES": _WITH_LARGE_PAGES if has_large_pages else "",
        "SIZE": size,
        "WIDE": WIDTH * size,
        "NUMBER": constants.size,
        "CONSTANTS": 8 * constants.size,
        "COPIES_IN": copies[0],
        "COPIES_OUT": copies[1],
    }.items():
        handler = handler.replace(f"${key}$", str(value))
    texts = [
        _module(emission, [*functions.values(), *others])
        for functions, others in [
            (emission.functions, [_LATE, _helpers(), handler]),
            *((functions, [_LATE]) for functions in emission.late),
        ]
    ]
    digest = hashlib.sha256("".join(texts).encode())
    for x in (constants, *tables):
        digest.update(x.tobytes())
    name = f"enerjax_{digest.hexdigest()[:32]}"
    _library().add(name, texts, constants, tables)
    return Function(name, emission.length)


def _module(emission: Emission, functions: Sequence[str]) -> str:
    return "\n".join(
        [
            *sorted(emission.declared),
            *functions,
            "attributes #3 = { nounwind optnone noinline }",
            'attributes #0 = { nounwind noinline "no-trapping-math"="true" }',
            "attributes #2 = { nounwind noinline optnone }",
            "attributes #1 = { nounwind willreturn memory(none) }",
        ]
    )


def _copies(emission: Emission, inputs: list, outputs: list) -> tuple[str, str]:
    """The code that copies inputs to the memory, and outputs from it."""
    before, after = [], []
    for k, (dtype, first, count) in enumerate(inputs):
        if count == 0:
            continue
        before += [
            f"  %ia{k} = getelementptr ptr, ptr %args, i64 {k}",
            f"  %ib{k} = load ptr, ptr %ia{k}",
            f"  %ic{k} = getelementptr i8, ptr %ib{k}, i64 24",
            f"  %id{k} = load ptr, ptr %ic{k}",
            f"  %ie{k} = getelementptr double, ptr %m, i64 {emission.address(first)}",
            f"  call void @in_{dtype}(ptr %id{k}, ptr %ie{k}, i64 {count})",
        ]
    for k, (dtype, places) in enumerate(outputs):
        if places is None:
            continue
        after += [
            f"  %oa{k} = getelementptr ptr, ptr %rets, i64 {k}",
            f"  %ob{k} = load ptr, ptr %oa{k}",
            f"  %oc{k} = getelementptr i8, ptr %ob{k}, i64 24",
            f"  %od{k} = load ptr, ptr %oc{k}",
        ]
        addresses = emission.addresses(places)
        if np.all(np.diff(addresses) == 1):
            after += [
                f"  %oe{k} = getelementptr double, ptr %m, i64 {addresses[0]}",
                f"  call void @out_{dtype}(ptr %oe{k}, ptr %od{k}, i64 {places.size})",
            ]
        else:
            table = emission.cellar.table(addresses)
            after.append(
                f"  call void @pick_{dtype}(ptr %m, ptr inttoptr (i64 $T{table}$ to ptr), "
                f"ptr %od{k}, i64 {places.size})"
            )
    return "\n".join(before), "\n".join(after)


_LOOP = """define internal void @{name}({args}, i64 %n) #0 {{
entry:
  br label %loop
loop:
  %k = phi i64 [ 0, %entry ], [ %next, %loop ]
{body}
  %next = add i64 %k, 1
  %more = icmp ult i64 %next, %n
  br i1 %more, label %loop, label %end
end:
  ret void
}}
"""


@functools.cache
def _helpers() -> str:
    """Functions that copy arrays of each type to cells, and cells to arrays."""
    out = []
    for dtype, kind in _CODES.items():
        cell = "double" if dtype[0] == "f" else "i64"
        load = [
            f"  %a = getelementptr {kind}, ptr %x, i64 %k",
            f"  %v = load {kind}, ptr %a",
        ]
        widen, narrow = "  %w = ", "  %w = "
        if kind == cell:
            widen += f"bitcast {kind} %v to {cell}"
            narrow += f"bitcast {cell} %v to {kind}"
        elif dtype == "f4":
            widen += "fpext float %v to double"
            narrow += "fptrunc double %v to float"
        else:
            widen += f"{'sext' if dtype[0] == 'i' else 'zext'} {kind} %v to i64"
            narrow += f"trunc i64 %v to {kind}"
        store = lambda kind: [
            f"  %b = getelementptr {kind}, ptr %y, i64 %k",
            f"  store {kind} %w, ptr %b",
        ]
        two = "ptr %x, ptr %y"
        body = "\n".join([*load, widen, *store(cell)])
        out.append(_LOOP.format(name=f"in_{dtype}", args=two, body=body))
        read = [
            f"  %a = getelementptr {cell}, ptr %x, i64 %k",
            f"  %v = load {cell}, ptr %a",
        ]
        body = "\n".join([*read, narrow, *store(kind)])
        out.append(_LOOP.format(name=f"out_{dtype}", args=two, body=body))
        find = [
            "  %t = getelementptr i64, ptr %table, i64 %k",
            "  %i = load i64, ptr %t",
            f"  %a = getelementptr {cell}, ptr %x, i64 %i",
            f"  %v = load {cell}, ptr %a",
        ]
        body = "\n".join([*find, narrow, *store(kind)])
        three = "ptr %x, ptr %table, ptr %y"
        out.append(_LOOP.format(name=f"pick_{dtype}", args=three, body=body))
    return "\n".join(out)


# Asks Linux for large pages of the memory (`MADV_HUGEPAGE`) from its first whole page on.
# Without them, the steps of large systems read from more pages than the processor can look
# up quickly.
_WITH_LARGE_PAGES = """
  %begin = ptrtoint ptr %m to i64
  %after = add i64 %begin, 4095
  %first = and i64 %after, -4096
  %stop = add i64 %begin, $SIZE$
  %length = sub i64 %stop, %first
  %pages = inttoptr i64 %first to ptr
  %ignored = call i32 @madvise(ptr %pages, i64 %length, i32 14)"""
# The memory, in bytes, from which on it has large pages.
_LARGE = 4 << 20


# The function that XLA calls, by the interface of `xla/ffi/api/c_api.h`: the offsets are
# those of its structures. In a first call it is asked for the version of the interface, and
# answers with the one that it is called by.
_WITHOUT_PASSES = """
define internal ptr @passes_memory() {
  ret ptr null
}
"""
_HANDLER = """
declare ptr @malloc(i64)
declare i32 @madvise(ptr, i64, i32)
declare void @free(ptr)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
define ptr @handler(ptr %frame) {
entry:
  %e0 = getelementptr i8, ptr %frame, i64 8
  %e1 = load ptr, ptr %e0
  %asks = icmp ne ptr %e1, null
  br i1 %asks, label %answer, label %work
answer:
  %a0 = getelementptr i8, ptr %frame, i64 16
  %api = load ptr, ptr %a0
  %a1 = getelementptr i8, ptr %api, i64 32
  %version = load i64, ptr %a1
  %a2 = getelementptr i8, ptr %e1, i64 24
  %metadata = load ptr, ptr %a2
  %a3 = getelementptr i8, ptr %metadata, i64 24
  store i64 %version, ptr %a3
  ret ptr null
work:
  %m = call ptr @malloc(i64 $SIZE$)$LARGE_PAGES$
  %c = inttoptr i64 $C$ to ptr
  call void @llvm.memcpy.p0.p0.i64(ptr %m, ptr %c, i64 $CONSTANTS$, i1 false)
  %w = call ptr @passes_memory()
  %f0 = getelementptr i8, ptr %frame, i64 72
  %args = load ptr, ptr %f0
  %f1 = getelementptr i8, ptr %frame, i64 112
  %rets = load ptr, ptr %f1
$COPIES_IN$
  call void @main(ptr %frame, ptr %m, ptr %w)
$COPIES_OUT$
  call void @free(ptr %m)
  call void @free(ptr %w)
  ret ptr null
}
"""


# Where the function of a branch is. The first call compiles it.
_LATE = """
declare void @llvm.trap()
define internal ptr @late(i64 %number) #0 {
entry:
  %slot = getelementptr ptr, ptr inttoptr (i64 $BRANCHES$ to ptr), i64 %number
  %known = load atomic ptr, ptr %slot acquire, align 8
  %is_new = icmp eq ptr %known, null
  br i1 %is_new, label %new, label %end
new:
  %made = call ptr inttoptr (i64 $COMPILE$ to ptr)(i64 %number)
  %fails = icmp eq ptr %made, null
  br i1 %fails, label %failed, label %end
failed:
  call void @llvm.trap()
  unreachable
end:
  %branch = phi ptr [ %known, %entry ], [ %made, %new ]
  ret ptr %branch
}
"""


class _Compiled:
    """Code in memory, and all that it refers to.

    Branches that are compiled when they are first taken are kept as text until then.
    """

    def __init__(self, texts: list[str], constants: np.ndarray, tables: list[np.ndarray]):
        self._constants = np.ascontiguousarray(constants)
        self._tables = [np.ascontiguousarray(x) for x in tables]
        self._branches = np.zeros(len(texts), np.uintp)
        self._compile = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int64)(self._branch)
        self._lock = threading.Lock()
        self._engines: list[Any] = []
        main, *late = texts
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
        llvm = _llvm()
        addresses = {f"T{k}": x.ctypes.data for k, x in enumerate(self._tables)}
        addresses["C"] = self._constants.ctypes.data
        addresses["BRANCHES"] = self._branches.ctypes.data
        addresses["COMPILE"] = ctypes.cast(self._compile, ctypes.c_void_p).value or 0
        text = re.sub(r"\$(\w+)\$", lambda found: str(addresses[found[1]]), text)
        module = llvm.parse_assembly(text)
        module.verify()
        target = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(),
            features=llvm.get_host_cpu_features().flatten(),
            opt=OPTIMISATION,
            reloc="pic",
            jit=True,
        )
        with _options_for(llvm, len(text)):
            code = target.emit_object(module)
        # Only the code stays in memory, and not the text that it was made of.
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        self._engines.append(engine)
        return engine.get_function_address(name)


class _Library:
    """The compiled functions of this process. They stay, because XLA may call them."""

    def __init__(self):
        self._kept: dict[str, _Compiled] = {}

    def add(
        self, name: str, texts: list[str], constants: np.ndarray, tables: list[np.ndarray]
    ) -> None:
        if name in self._kept:
            return
        compiled = self._kept[name] = _Compiled(texts, constants, tables)
        capsule = jax.ffi.pycapsule(ctypes.c_void_p(compiled.address))
        jax.ffi.register_ffi_target(name, capsule, platform="cpu")


@functools.cache
def _library() -> _Library:
    return _Library()


@contextlib.contextmanager
def _options_for(llvm: Any, length: int) -> Iterator[None]:
    """Sets the options of LLVM for a text of this length.

    The options hold for the whole process, so they are set back afterwards. If another
    thread compiles at the same time, its code is correct in either order.
    """
    if length < _LONG_TEXT or llvm.llvm_version_info[0] > _KNOWN_LLVM:
        yield
        return
    for option in _QUICK:
        llvm.set_option("", option)
    try:
        yield
    finally:
        for option in _USUAL:
            llvm.set_option("", option)


@functools.cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm
