"""Programs of JAX: tracing, sparsity, rewriting, and compiling into one function."""

from . import primitives as primitives
from .batching import in_any_lane as in_any_lane
from .compiled import (
    at_top_level as at_top_level,
    call_traced_once as call_traced_once,
    compiled as compiled,
    compiled_for_once as compiled_for_once,
    once_per_structure as once_per_structure,
    Readable as Readable,
    structure_of as structure_of,
    values_of as values_of,
)
from .counting import num_operations as num_operations
from .digest import checksum as checksum, digest as digest
from .hashable_indices import Indices as Indices
from .jaxprs import (
    as_array as as_array,
    evaluate as evaluate,
    function_with_own_derivative as function_with_own_derivative,
    interpret as interpret,
    is_known as is_known,
    module_of as module_of,
    name_of as name_of,
    parts_of_scan as parts_of_scan,
    programs_within as programs_within,
    wrapped_program as wrapped_program,
)
from .known_indices import computed_indices as computed_indices, is_index as is_index
from .machine_code import (
    in_one_function as in_one_function,
    part as part,
    why_not_one_function as why_not_one_function,
)
from .places import (
    at_all_places as at_all_places,
    at_places as at_places,
    with_any as with_any,
)
from .raising import raising as raising
from .simplification import simplified as simplified
from .sparsity.jacobian_columns import (
    columns_along as columns_along,
    columns_in_turn as columns_in_turn,
    jacobian_columns as jacobian_columns,
)
from .sparsity.pattern import (
    jacobian_pattern as jacobian_pattern,
    LARGE as LARGE,
    shape_of as shape_of,
)
from .squares import Squares as Squares, squares_in as squares_in
from .summands import summands_of as summands_of
