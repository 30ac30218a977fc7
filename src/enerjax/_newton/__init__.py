"""Newton's method, on functions whose arguments and values are scaled to order one."""

from .iterations import (
    max_norm as max_norm,
    newton_iterations as newton_iterations,
    PATIENCE as PATIENCE,
)
from .settings import Newton as Newton, Start as Start
