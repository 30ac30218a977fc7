"""Programs of JAX as functions of machine code."""
from .library import compiled_function as compiled_function, Function as Function
from .values import Unsupported as Unsupported
