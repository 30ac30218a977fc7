"""Compilation of the programs that users wait for."""

import functools
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, PyTree

from .garbage import few_searches_for_garbage
from .jaxprs import is_known
from .machine_code.calls import left_to_xla


# XLA's CPU back end has two generators of code for merged operations. The newer one, which
# is the default, takes twice as long, and its programs are not faster: two hinged bodies
# 18.6 s and 14.8 us a step with it, 9.9 s and 14.6 us without it (jaxlib 0.10.2).
_QUICKLY = {"xla_cpu_use_fusion_emitters": False}
# The code of a program that runs once, for microseconds, needs no optimisation: the checks
# of two hinged bodies compile in 1.4 s without it, and in 2.2 s with it.
_FOR_ONCE = _QUICKLY | {"xla_backend_optimization_level": 0}

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")
_Static: TypeAlias = tuple[tuple[tuple[Any, ...], tuple[Any, ...]], Any]
_Structure: TypeAlias = tuple[_Static, tuple[tuple[tuple[int, ...], Any], ...]]


def compiled(fn: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """`equinox.filter_jit(fn)`, which compiles in about half the time on CPUs.

    Inside of another `jax.jit`, and under `jax.grad` and other transformations, the program
    becomes part of another one, whose options decide.
    """
    return _compiled(fn, _QUICKLY)


def compiled_for_once(fn: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """`compiled(fn)` for a program that runs so rarely that its speed does not count."""
    return _compiled(left_to_xla(fn), _FOR_ONCE)


def _compiled(
    fn: Callable[Arguments, Value], options: dict[str, Any]
) -> Callable[Arguments, Value]:
    jit: Any = eqx.filter_jit
    alone, within = jit(fn, compiler_options=options), jit(fn)

    @functools.wraps(fn)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        # Some transformations of JAX set the mesh of devices, also where there is none. It
        # traces what it has traced under another mesh again.
        mesh = jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh())
        with mesh, few_searches_for_garbage():
            return choose(*args, **kwargs)

    def choose(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        if not (at_top_level((args, kwargs)) and _are_known()):
            return within(*args, **kwargs)
        try:
            return alone(*args, **kwargs)
        except ValueError as error:
            # JAX refuses options where a function in `args` has a traced closure.
            if "compiler_options" not in str(error):
                raise
            return within(*args, **kwargs)

    return call


class Readable:
    """`compiled(fn)` for calls outside of transformations, with a program to read.

    `fn` returns a pytree of arrays.
    """

    def __init__(self, fn: Callable[..., PyTree[Array]]):
        self._fn = fn

    @few_searches_for_garbage()
    def __call__(self, *args: Any) -> PyTree[Array]:
        return self._jitted(*_parts(args))

    def program(self, *args: Any) -> ClosedJaxpr:
        """The program that a call with these arguments runs; it is traced once for both."""
        return self._jitted.trace(*_parts(args)).jaxpr

    @functools.cached_property
    def _jitted(self) -> Any:
        def of_parts(static: _Static, arrays: list[Array]) -> PyTree[Array]:
            return self._fn(*_joined(static, arrays))

        options = _QUICKLY if _are_known() else None
        return jax.jit(of_parts, static_argnums=0, compiler_options=options)


def call_traced_once(fn: Callable[..., PyTree[Array]], *args: Any) -> PyTree[Array]:
    """`fn(*args)`, in a program one operation, which is traced once for all such calls.

    To trace a long function takes longer than all else that a program does with it.
    Outside of programs the function itself is called.
    """
    static, arrays = _parts((fn, args))
    if at_top_level(args) or not is_hashable(static):
        return fn(*args)
    return _traced_once(static, arrays)


@functools.partial(jax.jit, static_argnums=0)
def _traced_once(static: _Static, arrays: list[Array]) -> PyTree[Array]:
    fn, args = _joined(static, arrays)
    return fn(*args)


def once_per_structure(check: Callable[..., None]) -> Callable[..., None]:
    """A check of shapes and types that is not repeated for arguments of the same structure.

    To trace the functions of a user takes milliseconds, which would be most of a short run.
    Inside of transformations every call checks.
    """

    @functools.lru_cache(maxsize=128)
    def of_structure(structure: _Structure) -> None:
        static, types = structure
        check(*_joined(static, (jax.ShapeDtypeStruct(*x) for x in types)))

    @functools.wraps(check)
    def call(*args: Any) -> None:
        structure = structure_of(args) if at_top_level(args) else None
        return check(*args) if structure is None else of_structure(structure)

    return call


def structure_of(tree: PyTree[Any]) -> "_Structure | None":
    """What is static in a tree, with the types of its arrays, if that can be hashed.

    Calls of a compiled function with arguments of one structure run one program.
    """
    static, arrays = _parts(tree)
    if not is_hashable(static):
        return None
    return static, tuple((x.shape, x.dtype) for x in arrays)


def is_hashable(x: Any) -> bool:
    """Whether `x` can be a key: whether all of its parts can be hashed."""
    try:
        hash(x)
    except TypeError:
        return False
    return True


def _parts(tree: PyTree[Any]) -> tuple[_Static, list[Array]]:
    """What is static in a tree, which can be hashed, and its arrays."""
    leaves, structure = jax.tree.flatten(tree)
    is_array = [isinstance(x, jax.Array | np.ndarray | np.generic) for x in leaves]
    arrays = [x for on, x in zip(is_array, leaves, strict=True) if on]
    static = tuple(None if on else x for on, x in zip(is_array, leaves, strict=True))
    # 1, 1.0 and True are equal, but make different programs.
    return ((tuple(map(type, static)), static), structure), arrays


def _joined(static: _Static, arrays: Iterable[Any]) -> Any:
    """The tree of which `_parts` has made these parts."""
    inputs, (_, leaves), structure = iter(arrays), *static
    values = (next(inputs) if x is None else x for x in leaves)
    return jax.tree.unflatten(structure, values)


_zero = jax.jit(lambda: 0.0)


def at_top_level(arguments: PyTree[Any]) -> bool:
    """Whether a call with these arguments is outside of all transformations.

    A traced value in the closure of a function among them is not noticed.
    """
    return is_known(arguments) and not isinstance(_zero(), Tracer)


def values_of(tree: PyTree[Any]) -> PyTree[Any]:
    """The tree without derivatives.

    Its numbers are known in a call inside of `jax.grad` and `jax.jvp`, if these are not
    inside of other transformations themselves.
    """
    if is_known(tree):
        return tree
    still = lambda x: jnp.asarray(jax.lax.stop_gradient(x)) if eqx.is_array(x) else x
    return jax.tree.map(still, tree)


@functools.cache
def _are_known() -> bool:
    """Whether this version of XLA knows the options."""
    try:
        jax.jit(lambda: 0.0, compiler_options=_FOR_ONCE)()
    except (RuntimeError, ValueError):
        return False
    return True
