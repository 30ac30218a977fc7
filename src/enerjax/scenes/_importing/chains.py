"""Several hinges and slides in a row between two bodies, with no bodies between them.

A body of MuJoCo may have several joints, each of which moves the next one. A scene cannot
put bodies without mass between them, so the coordinates of the joints are eliminated. The
rows are the conditions on the relative motion that do not contain these coordinates, and
each coordinate is a function of the frames of the two bodies.

The frame between two successive hinges is called a *stage*. The first stage is body `a`,
the last is body `b`. A stage between them is determined by the axes of the hinges before
and behind it. In a chain of three hinges, the axis of the second follows from its angles to
the two others; two directions have these angles, and `branch` tells which one is meant.
"""

from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Multipliers, Scalar
from .._frames import Frame, Numbers, Point
from .._laws import AbstractConstraintLaw, Keeps
from .._measures import AbstractMeasure, AbstractTurn, offset


@dataclass(frozen=True)
class Chain:
    """The structure of a chain of joints.

    - `kinds`: of the joints in their order, `"hinge"`, `"slide"` or `"ball"`.
    - `meet`: whether all hinges go through one point. Else `numbers["links"]` are the
      vectors from each hinge to the next, in the stage between them.
    """

    kinds: tuple[str, ...]
    meet: bool

    @cached_property
    def num_turning(self) -> int:
        return sum(kind != "slide" for kind in self.kinds)

    @cached_property
    def stages(self) -> tuple[int, ...]:
        """The stage in which the axis of each slide is fixed."""
        turning = [kind != "slide" for kind in self.kinds]
        return tuple(
            sum(turning[:k]) for k, kind in enumerate(self.kinds) if kind == "slide"
        )

    @property
    def slides_together(self) -> bool:
        """Whether the axes of all slides are fixed in one stage."""
        return len(set(self.stages)) <= 1

    @property
    def turns_freely(self) -> bool:
        """Whether the joints leave every rotation."""
        return "ball" in self.kinds or self.num_turning == 3


class Stages:
    """The stages of a chain for two frames."""

    def __init__(self, chain: Chain, a: Frame, b: Frame, numbers: Numbers):
        self.chain, self._a, self._b, self._numbers = chain, a, b, numbers

    @cached_property
    def axes(self) -> list[Point]:
        """The axes of the hinges in space."""
        first = self._a.direction(self._numbers["frame_a"][2])
        last = self._b.direction(self._numbers["frame_b"][2])
        if self.chain.num_turning < 3:
            return [first, last][-self.chain.num_turning :]
        return [first, self._middle(first, last), last]

    def _middle(self, first: Point, last: Point) -> Point:
        """The second of three axes: a unit vector with known cosines to the others."""
        to_first, to_last = self._numbers["cosines"]
        between = jnp.sum(first * last)
        square = 1 - between**2
        along = to_first - between * to_last, to_last - between * to_first
        height = jnp.sqrt(square - along[0] * to_first - along[1] * to_last)
        aside = self._numbers["branch"] * height * jnp.cross(first, last)
        return (along[0] * first + along[1] * last + aside) / square

    def direction(self, stage: int, x: Point) -> Point:
        """A direction of a stage in space."""
        if stage == 0:
            return self._a.direction(x)
        if stage == self.chain.num_turning:
            return self._b.direction(x)
        before, behind = self.axes[stage - 1], self.axes[stage]
        cosine = self._numbers["cosines"][stage - 1]
        aside = (behind - cosine * before) / jnp.sqrt(1 - cosine**2)
        return x[0] * before + x[1] * aside + x[2] * jnp.cross(before, aside)

    @cached_property
    def slid(self) -> Point:
        """How far the slides have moved all hinges together, in space."""
        apart = offset(self._a, self._b, self._numbers)
        if self.chain.meet:
            return apart
        links = self._numbers["links"]
        fixed = [self.direction(k + 1, links[k]) for k in range(links.shape[0])]
        return apart - sum(fixed[1:], start=fixed[0])

    @cached_property
    def slides(self) -> list[Point]:
        """The axes of the slides in space."""
        axes = self._numbers["slides"]
        return [self.direction(s, axes[k]) for k, s in enumerate(self.chain.stages)]

    def shift(self, k: int) -> Scalar:
        """The displacement of the slide `k` among the slides."""
        chain, axes = self.chain, self.slides
        if chain.slides_together:
            dual = self.direction(chain.stages[k], self._numbers["duals"][k])
            return jnp.sum(self.slid * dual)
        third = axes[2] if len(axes) == 3 else jnp.cross(axes[0], axes[1])
        axes = [*axes[:2], third]
        normal = jnp.cross(axes[(k + 1) % 3], axes[(k + 2) % 3])
        return jnp.sum(self.slid * normal) / jnp.sum(axes[k] * normal)


@dataclass(frozen=True)
class ChainRows(AbstractConstraintLaw):
    """What a chain of joints leaves fixed between its two bodies."""

    chain: Chain

    @property
    def keeps(self) -> Keeps:
        if self.chain.turns_freely or self.chain.num_turning == 2:
            return None
        return "axis" if self.chain.num_turning else "directions"

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        stages = Stages(self.chain, a, b, numbers)
        return jnp.concatenate([_across(stages, numbers), self._turned(a, b, numbers)])

    def _turned(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        """The rows of the relative rotation."""
        if self.chain.turns_freely:
            return jnp.zeros((0,), a.origin.dtype)
        of_a = [a.direction(axis) for axis in numbers["frame_a"]]
        of_b = [b.direction(axis) for axis in numbers["frame_b"]]
        if self.chain.num_turning == 2:
            return (jnp.sum(of_a[2] * of_b[2]) - numbers["cosines"][0])[None]
        square = ((0, 2), (1, 2)) if self.chain.num_turning else ((0, 1), (1, 2), (2, 0))
        return jnp.stack([jnp.sum(of_a[i] * of_b[j]) for i, j in square])


def _across(stages: Stages, numbers: Numbers) -> Multipliers:
    """The components of the displacement across the axes of all slides."""
    slid, chain = stages.slid, stages.chain
    if not chain.stages:
        return slid
    if chain.slides_together:
        normals = [stages.direction(chain.stages[0], x) for x in numbers["normals"]]
    elif len(chain.stages) == 2:
        first, second = stages.slides
        normals = [jnp.cross(first, second)]
    else:
        normals = []
    rows: list[Array] = [jnp.sum(slid * normal) for normal in normals]
    return jnp.stack(rows) if rows else slid[:0]


@dataclass(frozen=True)
class ChainTurn(AbstractTurn):
    """The angle of a hinge in a chain of three.

    That of the second hinge is the angle from the first axis to the last, as they are seen
    along the second, less a constant whose cosine and sine are `numbers["turn"]`. That of
    another hinge is the angle of the second axis from `numbers["zero"]`, in the body where
    the axis of the hinge is fixed, to `numbers["across"]`.

    - `number`: that of the hinge, from 0.
    """

    chain: Chain
    number: int

    def components(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Scalar, Scalar]:
        first, middle, last = Stages(self.chain, a, b, numbers).axes
        if self.number != 1:
            body = a if self.number == 0 else b
            zero, across = (body.direction(numbers[key]) for key in ("zero", "across"))
            return jnp.sum(middle * zero), jnp.sum(middle * across)
        to_first, to_last = numbers["cosines"]
        along = jnp.sum(first * last) - to_first * to_last
        across = jnp.sum(middle * jnp.cross(first, last))
        c, s = numbers["turn"]
        return along * c + across * s, across * c - along * s


@dataclass(frozen=True)
class ChainSlide(AbstractMeasure):
    """The displacement of a slide in a chain, plus `numbers["zero"]`.

    - `number`: that of the slide among those of the chain, from 0.
    """

    chain: Chain
    number: int

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return Stages(self.chain, a, b, numbers).shift(self.number) + numbers["zero"]


@dataclass(frozen=True)
class ChainCoordinate(AbstractConstraintLaw):
    """A law without rows, which gives the coordinate of one joint of a chain a name."""

    measure: AbstractMeasure

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Float[Array, "0"]:
        return jnp.zeros((0,), a.origin.dtype)
