from typing import Any

import jax
from jax.core import Tracer


def is_known(tree: Any) -> bool:
    """Whether every number in `tree` has a value now: whether no leaf is traced."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))
