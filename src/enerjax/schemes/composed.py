import equinox as eqx

from .base import AbstractOneSolveScheme, AbstractScheme


class Composed(AbstractScheme):
    """A symmetric composition of a scheme, which has a higher order of accuracy.

    A step consists of stages, which are steps of lengths `stages[i] * h`, some of them
    backwards. Their sequence is symmetric and their leading errors cancel. The composition
    preserves what every stage preserves, such as the energy and the constraints.

    - Conserves, constraints held at: as the composed scheme.
    - Order: `order`, which is 4, 6 or 8 and above the order of the scheme. This requires a
      smooth discrete gradient: where `V` is not quadratic, the correction of `Gonzalez()`
      reduces orders 6 and 8.
    - Cost: one solve per stage. From order 2: 5, 9 and 17 stages for orders 4, 6 and 8;
      from order 4 (`EnergyConsistent(0.0)`): 5 and 9 for orders 6 and 8.
    - Applies to systems with driven constraints, but not with a `force`, because a damper
      would add energy in backward stages. Such a system raises a `ValueError`.

    **Arguments:**

    - `scheme`: `EnergyPreserving()`, `EnergyConsistent(0.0)` or
      `EnergyMomentumDecaying(0.0)`; for comparison `Rattle()`.
    - `order`: 4, 6 or 8.

    Raises a `ValueError` for a scheme that is not symmetric, whose backward stages would
    add energy, and for an order that is not above that of the scheme.

    **Reference:** order 4: M. Suzuki, Phys. Lett. A 146 (1990) 319-323; orders 6 and 8:
    W. Kahan and R.-C. Li, Math. Comp. 66 (1997) 1089-1099; see E. Hairer, C. Lubich and
    G. Wanner, Geometric Numerical Integration, section V.3. The nine stages from order 4 to
    8 are new here: they solve the order conditions for a scheme of order 4, with the
    longest stage as short as possible.
    """

    scheme: AbstractOneSolveScheme
    # Static, and determined at construction. Under transformations of JAX the parameters of
    # the scheme are traced, and whether alpha is zero is unknown.
    orders: tuple[int, int] = eqx.field(static=True)

    def __init__(self, scheme: AbstractOneSolveScheme, order: int):
        name = type(scheme).__name__
        if not isinstance(scheme, AbstractOneSolveScheme) or not scheme.symmetric:
            raise ValueError(
                f"`Composed({name})`: only symmetric schemes gain order by composition, "
                "`EnergyPreserving()`, `EnergyConsistent(0.0)` and "
                "`EnergyMomentumDecaying(0.0)`. The others dissipate, and a backward stage "
                "would feed that energy in again."
            )
        if (scheme.order, order) not in _HALVES:
            raise ValueError(
                f"`Composed({name}, order={order})`: use 4, 6 or 8, above the order "
                f"{scheme.order} of the scheme itself."
            )
        self.scheme = scheme
        self.orders = (scheme.order, order)

    @property
    def order(self) -> int:
        return self.orders[1]

    @property
    def stages(self) -> tuple[float, ...]:
        half = _HALVES[self.orders]
        return (*half, 1 - 2 * sum(half), *reversed(half))

    @property
    def stage(self) -> AbstractOneSolveScheme:
        return self.scheme


def _suzuki(order: int) -> tuple[float, float]:
    """Five stages that raise an even order by two; the two before the middle one."""
    outer = 1 / (4 - 4 ** (1 / (order + 1)))
    return (outer, outer)


# The stages before the middle one, for the order of the scheme and that of the composition.
_HALVES = {
    (2, 4): _suzuki(2),
    (4, 6): _suzuki(4),
    # These satisfy sum g = 1 and sum g^5 = sum g^7 = 0, and the commutator [A, [A, E_5]]
    # vanishes in the composed flow. Of the one-parameter family of solutions, this one has
    # the shortest longest stage, 0.488.
    (4, 8): (
        0.32,
        0.258106154759961138878,
        -0.4494189516643473579235,
        0.1274485068650754241988,
    ),
    (2, 6): (
        0.39216144400731413928,
        0.33259913678935943860,
        -0.70624617255763935981,
        0.08221359629355080023,
    ),
    (2, 8): (
        0.13020248308889008088,
        0.56116298177510838456,
        -0.38947496264484728641,
        0.15884190655515560090,
        -0.39590389413323757734,
        0.18453964097831570709,
        0.25837438768632204729,
        0.29501172360931029887,
    ),
}
