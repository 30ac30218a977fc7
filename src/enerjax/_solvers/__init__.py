"""Newton's method, differentiable roots and linear algebra. Contains no mechanics."""

from .linear.assembled import Assembled as Assembled, row_hessians as row_hessians
from .linear.block_diagonal import (
    as_dense as as_dense,
    BlockDiagonal as BlockDiagonal,
    blocks_of as blocks_of,
    diagonal_of as diagonal_of,
    hessian as hessian,
    in_blocks as in_blocks,
    inverse_of as inverse_of,
    is_positive_definite as is_positive_definite,
    padded as padded,
    scaled_blocks as scaled_blocks,
    Symmetric as Symmetric,
)
from .linear.cholesky_eigh import cholesky as cholesky, eigh as eigh
from .linear.dense import (
    AbstractFactors as AbstractFactors,
    inverse as inverse,
    product as product,
    SMALL as SMALL,
    solve_definite as solve_definite,
)
from .linear.independent_blocks import (
    constant_entries as constant_entries,
    independent_blocks as independent_blocks,
    IndependentBlocks as IndependentBlocks,
    multiply_by_blocks as multiply_by_blocks,
    solve_by_blocks as solve_by_blocks,
)
from .linear.jacobian import (
    affine_root as affine_root,
    form_of as form_of,
    kept_factors as kept_factors,
    regularised as regularised,
    RowPattern as RowPattern,
)
from .linear.norms import largest as largest
from .linear.schur import (
    Bounds as Bounds,
    Schur as Schur,
    schur as schur,
    schur_tables as schur_tables,
    SchurTables as SchurTables,
)
from .linear.user_solver import (
    AbstractSparseSolver as AbstractSparseSolver,
    KLU as KLU,
    SparsePattern as SparsePattern,
)
from .newton import ChordAlone as ChordAlone, Newton as Newton
from .newton_iterations import max_norm as max_norm
from .root import find_root as find_root, ROOT as ROOT
from .root_finding import (
    Chord as Chord,
    Root as Root,
    RootFinder as RootFinder,
)
