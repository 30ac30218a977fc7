"""The forces of a scene that have no potential, and the resistance of its dampers."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._system import AbstractDampedForce
from .._types import Coordinates, Scalar, Velocities
from ._laws import AbstractForceLaw
from ._layout import Layout, Links
from ._motion_view import Moving
from ._parameters import Parameters
from ._pose_view import evaluate_all, lift, View
from ._signals import at_time


# The groups of forces, with the numbers of each.
Pushes = list[tuple[Links, dict[str, Array]]]


class ForceOfScene(AbstractDampedForce):
    """The forces of dampers, actuators and loads, whose `args` are `Parameters`."""

    layout: Layout = eqx.field(static=True)

    def __call__(self, q, v, t, args=None):
        view = Moving(self.layout, q, v, args)
        groups = self._groups(view, t, args)
        now, pull = jax.vjp(lambda v: self._rates(groups, q, v), v)
        return pull(_forces(groups, view, now))[0]

    def measures(self, q, args=None):
        groups = zip(self.layout.push_groups, args.tables["forces"], strict=True)
        resisting = [
            (group, numbers)
            for group, numbers in groups
            if group is not None and _law(group).resists
        ]
        return tuple(evaluate_all(resisting, View(self.layout, q)))

    def resistances(self, q, v, t, args=None, *, delay):
        def forces(added: Scalar) -> list[Array]:
            view = Moving(self.layout, q, v, args, added=(delay * added, added))
            groups = [x for x in self._groups(view, t, args) if _law(x[0]).resists]
            now = self._rates(groups, q, v)
            return _forces(groups, view, [rate + added for rate in now])

        zero = jnp.zeros((), q.dtype)
        slopes = jax.jvp(forces, (zero,), (jnp.ones_like(zero),))[1]
        return tuple(-slope for slope in slopes)

    def _groups(self, view: Moving, t: Scalar, args: Parameters) -> Pushes:
        pairs = zip(self.layout.push_groups, args.tables["forces"], strict=True)
        return [
            (group, at_time(group, numbers, t, args, view))
            for group, numbers in pairs
            if group is not None
        ]

    def _rates(self, groups: Pushes, q: Coordinates, v: Velocities) -> list[Array]:
        """The rates of the measures of all groups."""
        measures = lambda x: evaluate_all(groups, View(self.layout, x))
        return jax.jvp(measures, (q,), (lift(self.layout, q, v),))[1]


def _forces(groups: Pushes, view: View, rates: list[Array]) -> list[Array]:
    return [pushes(*pair, view, x) for pair, x in zip(groups, rates, strict=True)]


def pushes(group: Links, numbers: dict[str, Array], view: View, rate: Array) -> Array:
    """The forces of all links along their measures."""
    law = _law(group)
    a, b = view.all_frames([(group.a, law.reads), (group.b, law.reads)])
    return jax.vmap(law.force)(a, b, rate, numbers)


def _law(group: Links) -> AbstractForceLaw:
    assert isinstance(group.law, AbstractForceLaw)
    return group.law
