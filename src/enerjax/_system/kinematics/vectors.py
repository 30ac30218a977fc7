"""Vectors in space, of all bodies at once.

A vector is a list of three components, which are arrays with an entry for each body.
Written in components, formulas compile to a single loop over the bodies. With arrays of
vectors XLA would compute the operands of each vector product several times.
"""

from collections.abc import Sequence
from typing import TypeAlias

from jaxtyping import Array, Float


Component: TypeAlias = Float[Array, " bodies"]
Vector3: TypeAlias = Sequence[Component]


def added(a: Vector3, b: Vector3) -> Vector3:
    return [x + y for x, y in zip(a, b, strict=True)]


def scaled(factor: Array | float, a: Vector3) -> Vector3:
    return [factor * x for x in a]


def dot(a: Vector3, b: Vector3) -> Component:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector3, b: Vector3) -> Vector3:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def sum_of_products(a: Sequence[Vector3], b: Sequence[Vector3]) -> Vector3:
    """`sum a_i x b_i`"""
    x, y, z = (cross(a_i, b_i) for a_i, b_i in zip(a, b, strict=True))
    return added(added(x, y), z)


def in_axes(axes: Sequence[Vector3], vector: Vector3) -> Vector3:
    """The components of a vector in body axes."""
    return [dot(axis, vector) for axis in axes]


def rates_of_directors(axes: Sequence[Vector3], spin: Vector3) -> list[Vector3]:
    """The rates `R (W x e_i)` of the directors; linear in the directors."""
    combined = lambda p, a, q, b: added(scaled(p, a), scaled(-q, b))
    return [
        combined(spin[2], axes[1], spin[1], axes[2]),
        combined(spin[0], axes[2], spin[2], axes[0]),
        combined(spin[1], axes[0], spin[0], axes[1]),
    ]
