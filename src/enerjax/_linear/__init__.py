from .assembled import (
    Assembled as Assembled,
    row_hessians as row_hessians,
)
from .blocks import (
    as_dense as as_dense,
    BlockDiagonal as BlockDiagonal,
    blocks_of as blocks_of,
    hessian as hessian,
    in_blocks as in_blocks,
    inverse_of as inverse_of,
    Symmetric as Symmetric,
)
from .dense import (
    AbstractFactors as AbstractFactors,
    Inverse as Inverse,
    inverse as inverse,
    product as product,
    solve as solve,
)
from .given import KLU as KLU
from .indices import Indices as Indices
from .jacobian import (
    affine_root as affine_root,
    kept_factors as kept_factors,
    Linearisable as Linearisable,
    linearisable as linearisable,
    narrowed as narrowed,
    RowPattern as RowPattern,
)
from .norms import largest as largest
from .parts import (
    constant_entries as constant_entries,
    multiply_parts as multiply_parts,
    Parts as Parts,
    parts_of as parts_of,
    solve_parts as solve_parts,
)
from .pattern import jacobian_pattern as jacobian_pattern, LARGE as LARGE
from .symmetric import cholesky as cholesky, eigh as eigh
