"""The problems and schemes of the order table, and the steps that show the orders."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import references
from references import Minimal

import enerjax as ej


# Errors are the largest at these fractions of a run. At its end alone an error could vanish
# by chance, where it changes its sign.
CHECKPOINTS = np.array([0.25, 0.5, 0.75, 1.0])


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem, how long it runs, and in how many steps at the coarsest.

    `coarsest` depends on the kind of scheme: high orders need long steps to stay above
    round-off over two halvings, low orders need short steps to reach their limit.
    """

    name: str
    problem: Callable[[], ej.problems.Problem]
    minimal: Minimal
    end_time: float
    coarsest: dict[str, int]
    energy_scale: float
    energy_scale_name: str
    constrained: bool = True
    # Whether V or Phi is beyond quadratic in more than one coordinate.
    curved: bool = False
    kinematics: bool = False

    @property
    def times(self) -> np.ndarray:
        return self.end_time * CHECKPOINTS


CASES = (
    Case(
        name="spring pendulum",
        problem=ej.problems.spring_pendulum,
        minimal=references.SPRING_PENDULUM,
        end_time=2.0,
        coarsest={"EP": 100, "ED": 400, "ED MeanValue": 100, "EC0": 48, "EC": 100}
        | {"EP4": 48, "EP6": 32, "EP8": 16, "EC6": 24, "EC8": 8},
        energy_scale=9.81,
        energy_scale_name="m g l",
        constrained=False,
        curved=True,
    ),
    Case(
        name="pendulum in its angle",
        problem=ej.problems.pendulum_angle,
        minimal=references.PENDULUM_ANGLE,
        end_time=2.0,
        coarsest={"EP": 100, "ED": 100, "EC0": 24, "EC": 48}
        | {"EP4": 24, "EP6": 12, "EP8": 8, "EC6": 8, "EC8": 4},
        energy_scale=9.81,
        energy_scale_name="m g l",
        constrained=False,
    ),
    Case(
        name="pendulum in x, y",
        problem=ej.problems.pendulum,
        minimal=references.PENDULUM,
        end_time=2.0,
        coarsest={"EP": 100, "ED": 400, "kappa": 100, "EC0": 24, "EC": 100}
        | {"EP4": 24, "EP6": 16, "EP8": 12, "EC6": 12, "EC8": 4},
        energy_scale=9.81,
        energy_scale_name="m g l",
    ),
    Case(
        name="double pendulum",
        problem=ej.problems.double_pendulum,
        minimal=references.DOUBLE_PENDULUM,
        end_time=2.0,
        coarsest={"EP": 200, "ED": 800, "kappa": 200, "EC0": 48, "EC": 100}
        | {"EP4": 48, "EP6": 40, "EP8": 24, "EC6": 48, "EC8": 20},
        energy_scale=29.43,
        energy_scale_name="m1 g l1 + m2 g (l1 + l2)",
    ),
    Case(
        name="heavy top",
        problem=ej.problems.heavy_top,
        minimal=references.HEAVY_TOP,
        end_time=0.2,
        coarsest={"EP": 100, "ED": 400, "kappa": 100, "EP4": 48, "EP6": 32, "EP8": 20},
        energy_scale=5435.7,
        energy_scale_name="kinetic energy at the start",
        kinematics=True,
    ),
)
QUICK_CASES = ("spring pendulum", "double pendulum")


@dataclasses.dataclass(frozen=True)
class Method:
    """A scheme as the table names it, its kind, and the order that theory gives it."""

    name: str
    kind: str
    scheme: ej.AbstractScheme
    expected: int


def methods(case: Case) -> Iterator[list[Method]]:
    """The schemes that are defined on a problem; those of a group share one program.

    Each is listed once. Without constraints the two formulations are the same scheme, and
    so are `KappaDecaying` and `EnergyDecaying`; the discrete gradients differ only if the
    problem is `curved`.
    """
    mean = ej.MeanValue()
    yield [Method("EnergyPreserving()", "EP", ej.EnergyPreserving(), 2)]
    if case.constrained:
        scheme = ej.EnergyPreserving("index3")
        yield [Method('EnergyPreserving("index3")', "EP", scheme, 2)]
    order = 2 if case.constrained or case.curved else 3
    yield [
        Method(f"EnergyDecaying({a})", "ED", ej.EnergyDecaying(a), order)
        for a in (0.5, 1.0)
    ]
    if case.curved:
        yield [
            Method(
                f"EnergyDecaying({a}, MeanValue())",
                "ED MeanValue",
                ej.EnergyDecaying(a, derivative=mean),
                3,
            )
            for a in (0.5, 1.0)
        ]
    if case.constrained:
        # Its velocities violate the constraints to first order in h.
        yield [
            Method(
                f'EnergyDecaying({a}, "index3")',
                "ED",
                ej.EnergyDecaying(a, "index3"),
                1,
            )
            for a in (0.5, 1.0)
        ]
        yield [Method("KappaDecaying(0.5)", "kappa", ej.KappaDecaying(0.5), 2)]
    if not case.kinematics:
        yield [
            Method(
                f"EnergyConsistent({a})",
                "EC" if a else "EC0",
                ej.EnergyConsistent(a),
                3 if a else 4,
            )
            for a in (0.0, 0.5, 1.0)
        ]
    for order in (4, 6, 8):
        name, kind = "Composed(EnergyPreserving({}), {})", f"EP{order}"
        scheme = ej.Composed(ej.EnergyPreserving(), order)
        yield [Method(name.format("", order), kind, scheme, order)]
        if case.curved:
            scheme = ej.Composed(ej.EnergyPreserving(derivative=mean), order)
            yield [Method(name.format("MeanValue()", order), kind, scheme, order)]
    if not case.kinematics:
        for order in (6, 8):
            scheme = ej.Composed(ej.EnergyConsistent(0.0), order)
            name = f"Composed(EnergyConsistent(0.0), {order})"
            yield [Method(name, f"EC{order}", scheme, order)]
