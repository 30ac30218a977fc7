"""A setting of XLA's CPU back end that speeds up time loops several times."""

import os

import jax
import jax.numpy as jnp
import jaxlib


# A loop that touches no more bytes than this is compiled into one function, if it calls no
# library inside (1024 by default).
_FLAGS = ["--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"]
if jaxlib.version.__version_info__ >= (0, 10, 2):
    # Without this flag small reductions and products would call a library. XLA ends the
    # process at a flag that it does not know, as in older versions.
    _FLAGS.append("--xla_cpu_experimental_ynn_fusion_type=-dot,-reduce,-eltwise")
    # For the time of compilation; see `compiled`.
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")


def enable_fast_loops() -> None:
    """Let XLA compile a whole time loop into one function, on CPUs.

    Runs of small systems and their derivatives are compiled into one function without this
    call, where that is possible. Larger systems, and models with operations that a single
    function cannot have, can be faster with it: measure yours. The decision is yours,
    because it holds for all of JAX in the process: the call appends to the environment
    variable `XLA_FLAGS` and starts the CPU back end. Make it right after the imports,
    before the first array is created (and after `jax.distributed.initialize`, if you use
    it). Other processors are not affected.

    **Raises:** `RuntimeError` if the back end had started before, so that the setting came
    too late (or was not understood by this version of XLA).
    """
    before = os.environ.get("XLA_FLAGS", "")
    missing = [flag for flag in _FLAGS if flag not in before]
    os.environ["XLA_FLAGS"] = " ".join([before, *missing]).strip()
    if not _are_fast():
        os.environ["XLA_FLAGS"] = before
        raise RuntimeError(
            "`enable_fast_loops()` came too late: JAX had already started its CPU back "
            "end, which reads its settings only once. Call it right after `import "
            "enerjax`, before anything that makes an array or lists devices. "
            f"(JAX {jax.__version__}; if it was the first call, this version has no such "
            "setting, and all works without.)"
        )


def are_enabled() -> bool:
    """Whether loops of any size are compiled into one function."""
    return _FLAGS[0].partition("=")[2].partition("=")[0] in os.environ.get("XLA_FLAGS", "")


def _are_fast() -> bool:
    """Whether XLA compiles a loop into one function that is too large for its default."""
    cpu = jax.devices("cpu")[0]
    like = jax.ShapeDtypeStruct((4096,), jnp.float32)
    loop = lambda x: jax.lax.fori_loop(0, 9, lambda _, y: jnp.sin(y) + x, x)
    with jax.default_device(cpu):
        text = jax.jit(loop).lower(like).compile().as_text()
    return text is not None and "xla_cpu_small_call" in text
