"""One rule for each primitive: the table of the chain rule for difference quotients.

| primitives | increment of the output |
|---|---|
| linear and structural | the same operation on the increments |
| `mul`, `dot_general` | `du mean(v) + mean(u) dv` |
| `div` | `(du mean(v) - mean(u) dv) / (v_a v_b)` |
| elementary functions | their quotient in `elementary.py` times the increment |
| `pow` | of `exp(y log x)`, with its limits at zero; of `sqrt(x)**n` for a fixed half-integer power |
| `atan2` | angle turned, from the cross and dot products of the two points |
| `max`, `min`, `clamp`, `reduce_max` | from that of `abs` |
| `sign`, `floor`, `ceil`, `round` | the difference quotient across a step, else zero |
| comparisons, `select_n`, `cond` | exact if the choice is the same at both points; else the difference quotient with respect to the numbers that decided |
| `reduce_prod` | telescoping product, in both orders |
| `cholesky`, `triangular_solve`, `custom_linear_solve`, `lu`, inverse | `linalg.py` |
| `scan` | the rule of its body, with the increment in the carry |
| `jit`, `remat`; functions of JAX with a derivative of their own | of the program inside |
| other functions under `custom_jvp`, `custom_vjp` | `fallback.py`, with the derivative that they define |
| all others | `fallback.py` |
"""  # noqa: E501

import jax
import jax.numpy as jnp

from .._programs import primitives
from . import arithmetic, elementary, linalg, loops, piecewise
from .arithmetic import linear, rewritten, unary
from .transform import Rule


RULES: dict[str, Rule] = {
    **{name: linear(*moved) for name, moved in primitives.DATA_MOVEMENT.items()},
    **dict.fromkeys(primitives.COMPONENTS, linear()),
    **dict.fromkeys(["cumsum", "reduce_sum", "sharding_constraint"], linear()),
    "scatter-add": linear(0, 2),
    **dict.fromkeys("add sub neg add_any".split(), piecewise.sum_entries),
    # The values differ, although their derivative is stopped.
    **dict.fromkeys(
        ["stop_gradient", "optimization_barrier"], lambda values, params: values
    ),
    "mul": arithmetic.product,
    "dot_general": arithmetic.product,
    "div": arithmetic.div,
    "integer_pow": arithmetic.integer_pow,
    "pow": arithmetic.power,
    "square": unary(lambda a, b: a + b),
    "sqrt": unary(elementary.sqrt),
    "rsqrt": unary(elementary.rsqrt),
    "cbrt": unary(elementary.cbrt),
    "exp": unary(elementary.exp),
    "exp2": unary(elementary.exp2),
    "expm1": unary(elementary.exp),
    "log": unary(elementary.log),
    "log1p": unary(elementary.log1p),
    "sin": unary(elementary.sin),
    "cos": unary(elementary.cos),
    "tan": unary(elementary.tan),
    "sinh": unary(elementary.sinh),
    "cosh": unary(elementary.cosh),
    "tanh": unary(elementary.tanh),
    "logistic": unary(elementary.logistic),
    "atan": unary(elementary.atan),
    "atanh": unary(elementary.atanh),
    "asin": rewritten(lambda x: 2 * jnp.arctan(x / (1 + jnp.sqrt((1 - x) * (1 + x))))),
    "acos": rewritten(lambda x: -2 * jnp.arctan(x / (1 + jnp.sqrt((1 - x) * (1 + x))))),
    "asinh": rewritten(lambda x: 2 * jnp.arctanh(x / (1 + jnp.sqrt(1 + x * x)))),
    "acosh": rewritten(lambda x: jnp.log(x + jnp.sqrt((x - 1) * (x + 1)))),
    "erf": unary(elementary.smooth(jax.scipy.special.erf, 0.4)),
    "erfc": unary(elementary.smooth(jax.scipy.special.erfc, 0.4)),
    "abs": arithmetic.absolute,
    **dict.fromkeys(primitives.PIECEWISE_CONSTANT, piecewise.piecewise_constant),
    "atan2": piecewise.atan2,
    "max": arithmetic.extreme(1),
    "min": arithmetic.extreme(-1),
    "reduce_max": arithmetic.reduce_extreme(jnp.maximum),
    "reduce_min": arithmetic.reduce_extreme(jnp.minimum),
    **dict.fromkeys(primitives.LOGICAL_REDUCTIONS, piecewise.reduce_logic),
    "clamp": rewritten(lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high)),
    **dict.fromkeys(primitives.COMPARISONS | primitives.LOGIC, piecewise.compare),
    "convert_element_type": piecewise.convert,
    "select_n": piecewise.select,
    "reduce_prod": arithmetic.reduce_prod,
    "cholesky": linalg.cholesky,
    "triangular_solve": linalg.triangular_solve,
    "custom_linear_solve": linalg.linear_solve,
    "lu": linalg.lu,
    "jit enerjax_inverse": linalg.inverse,
    "scan": loops.scan,
    "cond": loops.cond,
}
