"""The functions around the kernels of a program, as code for LLVM.

The handler is the function that XLA calls. It takes memory for all numbers, copies the
constants and the inputs to it, runs the program, and copies the outputs.
"""

import functools
import sys
from collections.abc import Sequence

import numpy as np

from . import addresses
from .emission import Emission
from .loops import WIDTH
from .passes import PASSES


_CODES = {"f8": "double", "f4": "float", "b1": "i8"} | {
    f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)
}


def texts_of(emission: Emission, inputs: list, outputs: list) -> list[str]:
    """The modules of a program: the one with the handler, and one for each branch that is
    compiled when it is first taken."""
    # The copies come first, because they add tables, and the modules need the number of all
    # tables.
    copies = _copies(emission, inputs, outputs)
    # One more, because kernels may read the cell behind a number, and a line of the cache,
    # because the memory begins with the first whole one.
    size = 8 * (emission.cellar.num_constants + emission.cellar.size + 1) + 64
    handler = (PASSES if emission.has_passes else _WITHOUT_PASSES) + _HANDLER
    has_large_pages = sys.platform == "linux" and size >= _LARGE
    num_constants = sum(map(len, emission.cellar.constants))
    for key, value in {
        "LARGE_PAGES": _WITH_LARGE_PAGES if has_large_pages else "",
        "SIZE": size,
        "WIDE": WIDTH * size,
        "NUMBER": num_constants,
        "CONSTANTS": 8 * num_constants,
        "COPIES_IN": copies[0],
        "COPIES_OUT": copies[1],
    }.items():
        handler = handler.replace(f"${key}$", str(value))
    return [
        _module(emission, [*functions.values(), *others])
        for functions, others in [
            (emission.functions, [_LATE, _helpers(), handler]),
            *((functions, [_LATE]) for functions in emission.late),
        ]
    ]


def _module(emission: Emission, functions: Sequence[str]) -> str:
    return "\n".join(
        [
            addresses.declaration(len(emission.cellar.tables)),
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
        cells = emission.addresses(places)
        if np.all(np.diff(cells) == 1):
            after += [
                f"  %oe{k} = getelementptr double, ptr %m, i64 {cells[0]}",
                f"  call void @out_{dtype}(ptr %oe{k}, ptr %od{k}, i64 {places.size})",
            ]
        else:
            table = addresses.table(emission.cellar.table(cells))
            after += [
                f"  %ot{k} = {addresses.loaded(table)}",
                f"  call void @pick_{dtype}(ptr %m, ptr %ot{k}, ptr %od{k}, "
                f"i64 {places.size})",
            ]
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
  %begin = ptrtoint ptr %all to i64
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
_HANDLER = f"""
declare ptr @malloc(i64)
declare i32 @madvise(ptr, i64, i32)
declare void @free(ptr)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
define ptr @handler(ptr %frame) {{
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
  %all = call ptr @malloc(i64 $SIZE$)$LARGE_PAGES$
  %all_begin = ptrtoint ptr %all to i64
  %all_after = add i64 %all_begin, 63
  %line = and i64 %all_after, -64
  %m = inttoptr i64 %line to ptr
  %c = {addresses.loaded(addresses.CONSTANTS)}
  call void @llvm.memcpy.p0.p0.i64(ptr %m, ptr %c, i64 $CONSTANTS$, i1 false)
  %w = call ptr @passes_memory()
  %f0 = getelementptr i8, ptr %frame, i64 72
  %args = load ptr, ptr %f0
  %f1 = getelementptr i8, ptr %frame, i64 112
  %rets = load ptr, ptr %f1
$COPIES_IN$
  call void @main(ptr %frame, ptr %m, ptr %w)
$COPIES_OUT$
  call void @free(ptr %all)
  call void @free(ptr %w)
  ret ptr null
}}
"""


# Where the function of a branch is. The first call compiles it.
_LATE = f"""
declare void @llvm.trap()
define internal ptr @late(i64 %number) #0 {{
entry:
  %branches = {addresses.loaded(addresses.BRANCHES)}
  %slot = getelementptr ptr, ptr %branches, i64 %number
  %known = load atomic ptr, ptr %slot acquire, align 8
  %is_new = icmp eq ptr %known, null
  br i1 %is_new, label %new, label %end
new:
  %compile = {addresses.loaded(addresses.COMPILE)}
  %made = call ptr %compile(i64 %number)
  %fails = icmp eq ptr %made, null
  br i1 %fails, label %failed, label %end
failed:
  call void @llvm.trap()
  unreachable
end:
  %branch = phi ptr [ %known, %entry ], [ %made, %new ]
  ret ptr %branch
}}
"""
