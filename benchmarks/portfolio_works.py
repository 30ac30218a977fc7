"""The works of `portfolio.py`, with what is expected of them."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import planar_mechanisms as planar
import space_mechanisms as space
import user_systems as user
from references import HEAVY_TOP, solve, STRETCHED_DOUBLE_PENDULUM
from scipy.integrate import solve_ivp
from speed_accuracy_works import chain_rates

import enerjax as ej


Problem = ej.problems.Problem
# A model of another program, made with our module for that program.
Peer = Callable[[Any], Any]


@dataclasses.dataclass(frozen=True)
class Bars:
    """The most that is expected. All are `None` where nothing is.

    - `ratio`: the time of a step, relative to EXUDYN's; `us`: in microseconds.
    - `first_call`, `gradient_first_call`: seconds.
    - `gradient_ratio`: the time of the gradient, relative to the run.
    - `peak_mb`: the memory of the process after the first call.
    """

    ratio: float | None = None
    us: float | None = None
    first_call: float | None = 3.0
    gradient_ratio: float | None = 3.5
    gradient_first_call: float | None = 6.0
    peak_mb: float | None = None


@dataclasses.dataclass(frozen=True)
class Motion:
    """A start of a work, a step, and who else computes it.

    `reference`: the positions at the end, or the program whose run with a finer step gives
    them. With `diffrax` it computes our model, its constraints differentiated twice.
    """

    name: str
    problem: Callable[[], Problem]
    h: float
    reference: Callable[[], np.ndarray] | Literal["mujoco", "exudyn"]
    exudyn: Peer | None = None
    mujoco: Peer | None = None
    diffrax: bool = False
    bars: Bars = Bars()


@dataclasses.dataclass(frozen=True)
class Work:
    """A program: its motions differ in numbers only. The first one is differentiated.

    `positions` gives, from coordinates, the positions that are compared.
    """

    name: str
    scheme: str
    steps: int
    positions: Callable[[Any], np.ndarray]
    motions: tuple[Motion, ...]

    @property
    def gradient_steps(self) -> int:
        return min(self.steps, 1000)


def scheme_of(name: str) -> ej.AbstractScheme:
    names = {k: getattr(ej, k) for k in dir(ej) if k[0].isupper()}
    return eval(name, {"__builtins__": {}}, names)


PRESERVING = "EnergyPreserving()"
_CONSISTENT = Bars(first_call=5.0)


def _in_space(
    name: str,
    make: Callable[[], space.Mechanism],
    h: float,
    bars: Bars,
    *,
    is_open: bool,
) -> Motion:
    return Motion(
        name=name,
        problem=lambda: Problem(*make().scene().build()),
        h=h,
        reference="mujoco" if is_open else "exudyn",
        exudyn=lambda exudyn: exudyn.in_space(make()),
        mujoco=(lambda mujoco: mujoco.Model(make())) if is_open else None,
        bars=bars,
    )


def _hinged_bodies(count: int, steps: int) -> Work:
    at_rest, whirling = lambda: space.chain(count), lambda: space.whirling_chain(count)
    fast = Bars(ratio=0.4)
    motions = (
        _in_space(f"bodies-{count}", at_rest, 1e-3, Bars(ratio=0.2), is_open=True),
        _in_space(f"bodies-{count}-whirling", whirling, 1e-3, fast, is_open=True),
        _in_space(f"bodies-{count}-whirling-10ms", whirling, 1e-2, fast, is_open=True),
    )
    return Work(f"bodies-{count}", PRESERVING, steps, space.mass_centres, motions)


def _mechanism(
    name: str,
    make: Callable[[], space.Mechanism],
    steps: int,
    bars: Bars,
    *,
    scheme: str = PRESERVING,
    is_open: bool = False,
) -> Work:
    motion = _in_space(name, make, 1e-3, bars, is_open=is_open)
    return Work(name, scheme, steps, space.mass_centres, (motion,))


def _with_springs(
    name: str, make: Callable[[], space.Mechanism], scheme: str = PRESERVING
) -> Work:
    """With springs that no step resolves.

    An angle vibrates `sqrt(1e6 / J)` times a second, with the inertia `J` of a rod, 0.3.
    """
    stiff = lambda: space.with_springs(make(), 1e6)
    return _mechanism(name, stiff, 500, Bars(), scheme=scheme)


def _in_plane(q: Any) -> np.ndarray:
    return np.asarray(q).reshape(-1, 2)


def _points_at(masses: np.ndarray, length: float, end: float) -> np.ndarray:
    """Points on rods, by an explicit run with their tensions solved for."""
    y = np.zeros((2, masses.size, 2))
    y[0, :, 0] = length * np.arange(1, masses.size + 1)
    rates = lambda t, y: chain_rates(y, masses)
    options: dict[str, Any] = dict(method="DOP853", rtol=1e-11, atol=1e-13)
    return (
        solve_ivp(rates, (0, end), y.ravel(), **options)
        .y[: 2 * masses.size, -1]
        .reshape(-1, 2)
    )


def _points(
    name: str,
    count: int,
    steps: int,
    bars: Bars,
    scheme: str = PRESERVING,
    size: float = 1.0,
    h: float = 1e-3,
) -> Work:
    """A chain with this length (m) and mass (kg).

    A chain of 1 m oscillates faster the more points it has, and from 64 on a step of 1 ms
    does not resolve that. One whose rods are 1 m long oscillates slowly.
    """
    masses, length = np.full(count, size / count), size / count
    motion = Motion(
        name=name,
        problem=lambda: ej.problems.chain(count, length=size, mass=size),
        h=h,
        reference=lambda: _points_at(masses, length, steps * h),
        exudyn=lambda exudyn: exudyn.points(masses, length, 0.5),
        diffrax=count <= 512,
        bars=bars,
    )
    return Work(name, scheme, steps, _in_plane, (motion,))


_UNIT_PENDULUM = dict(m1=1.0, m2=1.0, l1=1.0, l2=1.0, g=9.81)


def _pendulum(name: str, scheme: str, bars: Bars) -> Work:
    steps, h = 10_000, 1e-3
    end = np.array([steps * h])
    motion = Motion(
        name=name,
        problem=lambda: ej.problems.chain(2, length=2.0, mass=2.0),
        h=h,
        reference=lambda: (
            solve(STRETCHED_DOUBLE_PENDULUM, _UNIT_PENDULUM, end).q[-1].reshape(2, 2)
        ),
        exudyn=lambda exudyn: exudyn.points((1.0, 1.0), 1.0, 0.9),
        diffrax=True,
        bars=bars,
    )
    return Work(name, scheme, steps, _in_plane, (motion,))


def _stretched_angles() -> Problem:
    """The double pendulum in its angles from the vertical, from the horizontal."""
    system, start, args = ej.problems.double_pendulum_angles()
    return Problem(system, ej.State(0 * start.q + np.pi / 2, start.v), args)


def _from_angles(q: Any) -> np.ndarray:
    return np.cumsum(np.stack([np.sin(q), np.cos(q)], axis=1), axis=0)


def _angles(name: str, scheme: str, bars: Bars) -> Work:
    motion = dataclasses.replace(
        _pendulum(name, scheme, bars).motions[0], problem=_stretched_angles
    )
    return Work(name, scheme, 10_000, _from_angles, (motion,))


def _arm_in_angles(bars: Bars) -> Work:
    chained = lambda: space.arm_in_plane(6)
    motion = Motion(
        name="arm-6-angles",
        problem=lambda: user.arm_in_angles(6),
        h=1e-3,
        reference="mujoco",
        exudyn=lambda exudyn: exudyn.in_plane(planar.arm(6)),
        mujoco=lambda mujoco: mujoco.Model(chained()),
        diffrax=True,
        bars=bars,
    )
    centres = lambda q: np.insert(user.arm_centres(q), 1, 0.0, axis=1)
    return Work(motion.name, PRESERVING, 1000, centres, (motion,))


def _linkage(
    name: str,
    problem: Callable[[], Problem],
    make: Callable[[], planar.Linkage],
    steps: int,
    reference: Callable[[], np.ndarray] | Literal["exudyn"],
) -> Work:
    motion = Motion(
        name=name,
        problem=problem,
        h=1e-3,
        reference=reference,
        exudyn=lambda exudyn: exudyn.in_plane(make()),
        bars=Bars(ratio=0.2),
    )
    positions = lambda q: np.asarray(q).reshape(-1, 3)[:, :2]
    return Work(name, PRESERVING, steps, positions, (motion,))


def _four_bars(count: int) -> Work:
    steps = 500

    def reference() -> np.ndarray:
        """All uprights turn alike: one equation for their angle from the vertical."""
        mass, weight = (count + 1) / 3 + count, 9.81 * ((count + 1) / 2 + count)
        rates = lambda t, y: np.array([y[1], weight / mass * np.sin(y[0])])
        run = solve_ivp(rates, (0, steps * 1e-3), [0.0, 1.0], rtol=1e-12, atol=1e-13)
        top = np.array([np.sin(run.y[0, -1]), np.cos(run.y[0, -1])])
        places = []
        for k in range(count + 1):
            places.append(0.5 * top + [k, 0])
            places.append(top + [k + 0.5, 0])
        return np.array(places[:-1])

    return _linkage(
        f"four-bars-{count}",
        lambda: ej.problems.parallel_bars(count),
        lambda: planar.parallel_bars(count),
        steps,
        reference,
    )


def _top(name: str, scheme: str, bars: Bars) -> Work:
    """The published top in directors, without a scene."""

    def reference() -> np.ndarray:
        args = ej.problems.heavy_top().args
        return solve(HEAVY_TOP, args, np.array([1.0])).q[-1][None, :3]

    motion = Motion(
        name=name,
        problem=ej.problems.heavy_top_directors,
        h=1e-3,
        reference=reference,
        exudyn=lambda exudyn: exudyn.in_space(space.top(across=0.234375)),
        mujoco=lambda mujoco: mujoco.Model(space.top(across=0.234375)),
        diffrax=True,
        bars=bars,
    )
    # The mass centre is at the tip of the second director.
    return Work(name, scheme, 1000, lambda q: np.asarray(q)[None, 3:6], (motion,))


def _in_euler_parameters(count: int) -> Work:
    name = f"bodies-{count}-euler"
    bars = Bars(first_call=15.0, gradient_first_call=None, peak_mb=1500.0)
    make = lambda: space.chain(count)
    motion = dataclasses.replace(
        _in_space(name, make, 1e-3, bars, is_open=True),
        problem=lambda: user.chain_in_euler_parameters(count),
    )
    return Work(name, PRESERVING, 1000, user.quaternion_centres, (motion,))


def _works() -> list[Work]:
    chained, loops = Bars(ratio=0.1), Bars(ratio=0.4)
    later = Bars(first_call=5.0)
    two = lambda: space.chain(2)
    return [
        *(
            _hinged_bodies(count, steps)
            for count, steps in (
                (1, 2000),
                (2, 2000),
                (6, 1000),
                (16, 500),
                (64, 200),
                (256, 100),
            )
        ),
        _mechanism("tree-30", lambda: space.tree(30), 500, loops, is_open=True),
        _with_springs("bodies-16-stiff", lambda: space.chain(16)),
        _with_springs("tree-30-stiff", lambda: space.tree(30)),
        _with_springs(
            "bodies-16-stiff-decaying", lambda: space.chain(16), "EnergyDecaying(0.5)"
        ),
        _mechanism("four-bar-in-space", space.four_bar, 500, loops),
        _mechanism("two-loops", space.two_loops, 500, loops),
        _mechanism("bricard", space.bricard, 500, loops),
        _points("points-8", 8, 1000, chained),
        _points("points-64", 64, 500, chained),
        _points("points-512", 512, 200, chained),
        _points("points-2000", 2000, 100, chained),
        *(
            _points(f"points-{count}-long", count, steps, chained, size=float(count))
            for count, steps in ((8, 1000), (64, 500), (512, 200))
        ),
        _linkage(
            "slider-crank", ej.problems.slider_crank, planar.slider_crank, 2000, "exudyn"
        ),
        *(_four_bars(count) for count in (1, 10, 40)),
        _top("top", PRESERVING, Bars(ratio=0.12)),
        _mechanism("top-as-body", space.top, 1000, Bars(ratio=0.12), is_open=True),
        _pendulum("pendulum", PRESERVING, Bars(ratio=0.1)),
        _pendulum(
            "pendulum-decaying",
            "EnergyDecaying(0.5)",
            dataclasses.replace(later, ratio=0.3),
        ),
        _pendulum(
            "pendulum-consistent",
            "EnergyConsistent(0.0)",
            dataclasses.replace(later, ratio=0.25),
        ),
        _angles("angles", PRESERVING, Bars(us=2.0)),
        _angles(
            "angles-consistent", "EnergyConsistent(0.0)", dataclasses.replace(later, us=4.0)
        ),
        _arm_in_angles(Bars(us=8.0)),
        _mechanism(
            "bodies-2-decaying",
            two,
            2000,
            later,
            scheme="EnergyDecaying(0.5)",
            is_open=True,
        ),
        _mechanism(
            "bodies-2-consistent",
            two,
            2000,
            later,
            scheme="EnergyConsistent(0.0)",
            is_open=True,
        ),
        _in_euler_parameters(5),
        _mechanism("arm-4", space.arm, 1000, Bars(), is_open=True),
        # RATTLE is explicit: a longer step of the larger chains is not stable.
        _points("rattle-8", 8, 1000, Bars(us=0.6), "Rattle()"),
        _points("rattle-64", 64, 500, Bars(us=3.5), "Rattle()", h=2e-4),
        _points("rattle-512", 512, 200, Bars(us=30.0), "Rattle()", h=1e-4),
        _top("rattle-top", "Rattle()", Bars()),
    ]


WORKS = {work.name: work for work in _works()}
