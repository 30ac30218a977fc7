"""Regular matrices that become block-diagonal by permutations of their rows and columns.

The map from the rates of the coordinates to the velocities is such a matrix, with one block
for each body.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..._programs import at_places, Indices, is_known, jacobian_pattern
from .dense import inverse, inverse_by_cofactors


class IndependentBlocks(Indices):
    """The rows and the columns of each block of a matrix.

    - `groups`: for each block size, that size and the rows and columns of all blocks of
      this size, two arrays of shape `(blocks, size)`. Blocks that contain the single entry
      one are a group of their own, whose size is recorded as zero.
    - `of_rows`, `of_columns`: the position of each row and column in the concatenated
      groups.
    """

    def __init__(self, labels: np.ndarray, is_one: np.ndarray):
        """From the block number of each row and column, and which blocks are just a one."""
        super().__init__(np.concatenate([*labels, is_one]))
        sizes = np.bincount(labels[0])
        places = np.argsort(labels, axis=1, kind="stable")
        starts, kinds = np.cumsum(sizes) - sizes, np.where(is_one, 0, sizes)
        self.groups = []
        for kind in np.unique(kinds):
            entries = starts[kinds == kind][:, None] + np.arange(max(kind, 1))
            self.groups.append((kind, *(x[entries] for x in places)))
        sides = ([group[side].ravel() for group in self.groups] for side in (1, 2))
        self.of_rows, self.of_columns = (np.argsort(np.concatenate(x)) for x in sides)


def independent_blocks(constants: Float[np.ndarray, "n n"]) -> IndependentBlocks | None:
    """The blocks of a regular matrix, from its constant entries; NaN for all others.

    `None` where the matrix has only one block.
    """
    size = len(constants)
    rows, columns = np.nonzero(constants)
    entries = np.ones(rows.size), (rows, size + columns)
    graph = scipy.sparse.csr_array(entries, shape=(2 * size, 2 * size))
    count, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    labels = labels.reshape(2, size)
    sizes, widths = (np.bincount(x, minlength=count) for x in labels)
    # A matrix with a block that is not square is singular. The solve will report that.
    if count == 1 or np.any(sizes != widths):
        return None
    ones = np.zeros(count, bool)
    ones[labels[0][rows[constants[rows, columns] == 1]]] = True
    return IndependentBlocks(labels, ones & (sizes == 1))


def constant_entries(
    fn: Callable[[PyTree[Array]], Array], inputs: PyTree
) -> Float[np.ndarray, "..."] | None:
    """The entries of the value of `fn` that do not depend on `inputs`; NaN for all others.

    They are found from the traced program, whatever the numbers in `inputs` are. `None`
    where the program does not show which entries are constant.
    """
    numbers, rest = eqx.partition(inputs, eqx.is_inexact_array)
    if not is_known(rest):
        return None
    flat, unravel = ravel_pytree(jax.tree.map(jnp.ones_like, numbers))
    program = jax.make_jaxpr(lambda x: fn(eqx.combine(unravel(x), rest)))(flat)
    if not is_known(program.consts):
        return None
    values = lambda x: jaxpr_as_fun(program)(x)[0]
    pattern = jacobian_pattern(values, flat, of_values=True)
    if pattern is None:
        return None
    with jax.ensure_compile_time_eval():
        # A constant entry has its value at any point.
        somewhere = np.asarray(jax.jit(values)(np.ones(flat.shape, flat.dtype)))
    depends = (np.diff(pattern.indptr) > 0).reshape(somewhere.shape)
    return np.where(depends, np.nan, somewhere)


def solve_by_blocks(
    blocks: IndependentBlocks | None, matrix: Float[Array, "n n"], right: Float[Array, " n"]
) -> Float[Array, " n"]:
    """`matrix^-1 right`, differentiable; not finite where the matrix is singular."""
    if blocks is None:
        return _solve(matrix[None], right[None])[0]
    pieces = []
    for size, rows, columns in blocks.groups:
        part = at_places(right, rows)
        pieces.append(_solve(_blocks(matrix, rows, columns), part) if size else part)
    return _joined(pieces, blocks.of_columns)


def multiply_by_blocks(
    blocks: IndependentBlocks, matrix: Float[Array, "n n"], x: Float[Array, " n"]
) -> Float[Array, " n"]:
    """`matrix @ x`, where each row depends on the columns of its own block only."""
    pieces = []
    for size, rows, columns in blocks.groups:
        part = at_places(x, columns)
        pieces.append(_times(_blocks(matrix, rows, columns), part) if size else part)
    return _joined(pieces, blocks.of_rows)


# The number of blocks up to which they are extracted one by one.
_FEW = 8


def _blocks(matrix: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
    if len(rows) > _FEW:
        return matrix[rows[:, :, None], columns[:, None, :]]
    cut = lambda r, c: at_places(at_places(matrix, r).T, c).T
    return jnp.stack([cut(r, c) for r, c in zip(rows, columns, strict=True)])


def _joined(pieces: list[Array], order: np.ndarray) -> Array:
    return at_places(jnp.concatenate([x.ravel() for x in pieces]), order)


@jax.custom_jvp
def _solve(
    blocks: Float[Array, "blocks k k"], right: Float[Array, "blocks k"]
) -> Float[Array, "blocks k"]:
    return _times(_inverses(blocks), right)


@_solve.defjvp
def _solve_jvp(primals, tangents):
    (blocks, right), (dblocks, dright) = primals, tangents
    x = _solve(blocks, right)
    return x, _times(_inverses(blocks), dright - _times(dblocks, x))


def _times(blocks: Array, x: Array) -> Array:
    return jnp.sum(blocks * x[:, None, :], axis=-1)


@jax.vmap
def _inverses(block: Float[Array, "k k"]) -> Float[Array, "k k"]:
    # An inverse with pivots takes four times as many operations as one by cofactors, and
    # would be most of the program of a body in quaternions. Cofactors lose digits only
    # where two or more singular values are far smaller than the largest one, whatever the
    # units.
    return inverse_by_cofactors(block) if len(block) <= 4 else inverse(block)
