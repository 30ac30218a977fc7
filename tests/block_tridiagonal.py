"""Block elimination along a chain, written with public names alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from enerjax import AbstractSparseSolver, SparsePattern


class BlockTridiagonal(AbstractSparseSolver):
    """Elimination block by block, for unknowns that touch those of the next block alone.

    - `order`: the numbers of the unknowns along the chain.
    - `width`: of a block, in unknowns.
    """

    order: tuple[int, ...] = eqx.field(static=True)
    width: int = eqx.field(static=True)

    def factorise(self, pattern: SparsePattern, entries: jax.Array):
        width, num_blocks = self.width, pattern.size // self.width
        place = np.argsort(self.order)
        block, row = np.divmod(place[pattern.rows], width)
        column = place[pattern.columns] - (block - 1) * width
        if np.any((column < 0) | (column >= 3 * width)):
            raise ValueError(f"Blocks of {width} unknowns touch more than the next block.")
        band = jnp.zeros((num_blocks, width, 3 * width), entries.dtype)
        band = band.at[block, row, column].set(entries)

        def eliminate(before, rows):
            below, own, above = jnp.split(rows, 3, axis=1)
            inverse = jnp.linalg.inv(own - below @ before)
            return inverse @ above, (below, inverse, inverse @ above)

        return jax.lax.scan(eliminate, jnp.zeros_like(band[0, :, :width]), band)[1]

    def solve(self, pattern: SparsePattern, factors, right: jax.Array) -> jax.Array:
        order = np.array(self.order)

        def forward(before, item):
            (below, inverse, _), own = item
            x = inverse @ (own - below @ before)
            return x, x

        def backward(after, item):
            (_, _, above), own = item
            x = own - above @ after
            return x, x

        none = jnp.zeros((self.width,), right.dtype)
        blocks = right[order].reshape(-1, self.width)
        _, blocks = jax.lax.scan(forward, none, (factors, blocks))
        _, blocks = jax.lax.scan(backward, none, (factors, blocks), reverse=True)
        return jnp.zeros_like(right).at[order].set(blocks.ravel())


def along_chain(num_links: int, links_per_block: int) -> BlockTridiagonal:
    """For points in the plane on rods, with `EnergyPreserving`.

    Its unknowns are the impulse of each rod, the two rates of each point, and the
    velocity-level impulse of each rod.
    """
    link = np.arange(num_links)
    impulse, rate, last = link, num_links + 2 * link, 3 * num_links + link
    order = np.stack([impulse, rate, rate + 1, last], axis=1).ravel()
    return BlockTridiagonal(tuple(order.tolist()), 4 * links_per_block)
