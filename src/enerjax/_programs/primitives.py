"""The primitives of JAX, in the classes that readers of programs tell apart.

Every module that walks a program asks here to which class a primitive belongs. A primitive
is in one of the basic classes only; `ELEMENTWISE` unites several of them.
"""


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


# Entry by entry ---------------------------------------------------------------------------

# The arithmetic of tangents: linear in all operands together, or in each of them.
ARITHMETIC = _names("add add_any convert_element_type div mul neg sub")
ELEMENTARY = _names("""
    abs acos acosh asin asinh atan atan2 atanh cbrt cos cosh digamma erf erf_inv erfc exp
    exp2 expm1 integer_pow lgamma log log1p logistic nextafter pow rem rsqrt sin sinh sqrt
    square tan tanh
""")
# These return one of their operands.
CHOICES = _names("clamp max min select_n")
# Linear functions of real and complex numbers.
COMPONENTS = _names("complex conj imag real reduce_precision")
# Their derivative is zero where they have one.
PIECEWISE_CONSTANT = _names("ceil floor round sign")
COMPARISONS = _names("eq ge gt is_finite le lt ne")
LOGIC = _names("and not or xor")
BITS = _names("population_count shift_left shift_right_arithmetic shift_right_logical")
ELEMENTWISE = (
    ARITHMETIC
    | ELEMENTARY
    | CHOICES
    | COMPONENTS
    | PIECEWISE_CONSTANT
    | COMPARISONS
    | LOGIC
    | BITS
)

# Between places ---------------------------------------------------------------------------

# Data movement, with the positions of the operands whose entries are moved, or `ALL` of
# them. The other operands are indices.
ALL = ()
DATA_MOVEMENT: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(_names("concatenate pad stack"), ALL),
    **dict.fromkeys(
        _names("""
            broadcast_in_dim copy dynamic_slice gather reshape rev slice split squeeze tile
            transpose unstack
        """),
        (0,),
    ),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
}
SCATTERS = _names("scatter scatter-add")


def moved_operands(name: str, count: int) -> tuple[int, ...]:
    """The positions, among `count` operands, of those whose entries a primitive moves."""
    return DATA_MOVEMENT[name] or tuple(range(count))


# Many entries to one ----------------------------------------------------------------------

REDUCTIONS = _names("reduce_max reduce_min reduce_prod reduce_sum")
LOGICAL_REDUCTIONS = _names("reduce_and reduce_or")
PLACES_OF_EXTREMES = _names("argmax argmin")
# Running sums, products and extremes along an axis.
CUMULATIVE = _names("cummax cummin cumprod cumsum")
CONTRACTION = "dot_general"

# Sorting, and factors of matrices.
FACTORS = _names("cholesky lu lu_pivots_to_permutation sort triangular_solve")

# Programs within --------------------------------------------------------------------------

# `jax.jit`, under the names that it has in the supported versions of JAX.
JIT = _names("jit pjit")
WITH_OWN_DERIVATIVE = _names("custom_jvp_call custom_vjp_call")
# Primitives that only wrap a program, and the parameter that holds it.
CALLS = {
    **dict.fromkeys(JIT, "jaxpr"),
    **dict.fromkeys(_names("checkpoint remat2"), "jaxpr"),
    **dict.fromkeys(WITH_OWN_DERIVATIVE, "call_jaxpr"),
    **dict.fromkeys(_names("closed_call core_call"), "call_jaxpr"),
}
# A linear solve, with programs for the products and the solutions of both directions.
LINEAR_SOLVE = "custom_linear_solve"
# Loops and branches.
CONTROL_FLOW = _names("cond scan while")
