from collections.abc import Sequence
from typing import Any, TypeAlias

from jaxtyping import Array, ArrayLike, Bool, Float, Int, ScalarLike
from typing_extensions import TypeAliasType


# Dimensions used in every annotation of the package:
# nq coordinates, nv velocities, nu increments (the unknowns of the motion in a step), nc
# constraints (joints first, then those of the coordinates), nj joint constraints. `...`
# stands for the time axis of a `Solution`.
Args = TypeAliasType("Args", Any)
Scalar: TypeAlias = Float[Array, ""]
Flag: TypeAlias = Bool[Array, ""]
Count: TypeAlias = Int[Array, ""]
Coordinates: TypeAlias = Float[Array, " nq"]
Velocities: TypeAlias = Float[Array, " nv"]
Increments: TypeAlias = Float[Array, " nu"]
Multipliers: TypeAlias = Float[Array, " nc"]
JointMultipliers: TypeAlias = Float[Array, " nj"]
Times: TypeAlias = Float[Array, " times"]
# The types of users' arguments have names, so that signatures can be read.
Real = TypeAliasType("Real", ScalarLike)
Vector = TypeAliasType("Vector", ArrayLike | Sequence[ScalarLike])
EntryIndices = TypeAliasType("EntryIndices", Sequence[int])
