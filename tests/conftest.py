import gc
import os
import pathlib

import jax
import jaxlib
import pytest


# These tests compile thousands of programs and run most of them for milliseconds: how long
# XLA takes counts, and not how fast its programs are. Without these it takes twice as long.
# Your own `XLA_FLAGS` come after them, and win. XLA ends the process at a flag that it does
# not know: the names are those of these versions.
if (0, 7, 2) <= jaxlib.version.__version_info__ < (0, 11):
    LESS = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    if LESS not in os.environ.get("XLA_FLAGS", ""):  # of the process that started this one
        os.environ["XLA_FLAGS"] = f"{LESS} {os.environ.get('XLA_FLAGS', '')}".strip()

jax.config.update("jax_enable_x64", True)
# Programs need not tell which lines they come from; errors of Python do all the same.
jax.config.update("jax_traceback_in_locations_limit", 0)
# Broadcasts between ranks and mixtures of dtypes in the package are oversights.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Marks as slow the variants of a test that `slow_for` names, by their parameters."""
    for item in items:
        names = item.get_closest_marker("slow_for")
        if names is not None and item.callspec.id in names.args:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True, scope="session")
def compile_quickly():
    """Also by LLVM, for the same reason."""
    from enerjax._programs.machine_code import compiler

    compiler.OPTIMISATION = 0


@pytest.fixture
def is_type_checked(request):
    """Whether the annotations of the package are enforced in this run."""
    return bool(request.config.getoption("--jaxtyping-packages", None))


# Tracing allocates millions of small objects that live for long. With its own settings,
# Python searches them for cycles so often that a twelfth of the time goes there.
gc.set_threshold(50_000, 20, 100)

# A process can map only so many pieces of memory, 65530 on most machines, and each compiled
# program takes some.
MAPS = pathlib.Path("/proc/self/maps")
MANY_MAPS = 25_000


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Modules share programs until there are too many to keep."""
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
