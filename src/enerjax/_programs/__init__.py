"""What is known of JAX programs: tracing, sparsity, rewriting, one machine function."""

from .fast_loops import enable_fast_loops as enable_fast_loops
from .indices import Indices as Indices
from .lanes import anywhere as anywhere
from .one_function.calls import in_one_function as in_one_function, unmerged as unmerged
from .one_function.possible import LARGEST_SUM as LARGEST_SUM
from .plain_products import plain_products as plain_products
from .sparsity.columns import (
    columns_along as columns_along,
    jacobian_columns as jacobian_columns,
)
from .sparsity.dependence import shape_of as shape_of
from .sparsity.pattern import jacobian_pattern as jacobian_pattern, LARGE as LARGE
from .tracing import (
    evaluate as evaluate,
    function_with_own_derivative as function_with_own_derivative,
    interpret as interpret,
    is_known as is_known,
    name_of as name_of,
    programs_within as programs_within,
    wrapped_program as wrapped_program,
)
