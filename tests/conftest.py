import jax
import pytest


jax.config.update("jax_enable_x64", True)
# Broadcasts between ranks and mixtures of dtypes in the package are oversights.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def is_type_checked(request):
    """Whether the annotations of the package are enforced in this run."""
    return bool(request.config.getoption("--jaxtyping-packages", None))


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """A process can map only so many compiled programs into its memory."""
    yield
    jax.clear_caches()
