"""LLVM: from the text of a module to machine code, and to functions in memory."""

import contextlib
import functools
from collections.abc import Iterator
from typing import Any


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


def object_of(text: str) -> bytes:
    """The machine code of a module, for this machine."""
    llvm = _llvm()
    module = llvm.parse_assembly(text)
    module.verify()
    with _options_for(llvm, len(text)):
        return _target().emit_object(module)


def loaded(code: bytes) -> Any:
    """Machine code in memory, which stays there as long as the result."""
    llvm = _llvm()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def machine() -> str:
    """What machine code depends on, beside the text that it is made of."""
    llvm = _llvm()
    features = llvm.get_host_cpu_features().flatten()
    parts = llvm.llvm_version_info, llvm.get_host_cpu_name(), features, OPTIMISATION
    return repr((llvm.get_default_triple(), *parts))


def _target() -> Any:
    llvm = _llvm()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=OPTIMISATION,
        reloc="pic",
        jit=True,
    )


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
