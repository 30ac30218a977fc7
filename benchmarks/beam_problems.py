"""Published problems of flexible beams, beside their references.

    python benchmarks/beam_problems.py [--only NAME] [--out FOLDER]

- Statics and modes (`beam_statics.py`): an end moment that closes a circle, the elastica,
  K. Nachbagauer's thick cantilever, a beam with coupled stiffnesses, the Princeton
  experiment, S. P. Timoshenko's linear solution, objectivity, and frequencies.
- `arc`: K.-J. Bathe and S. Bolourchi (1979), statics; the reference is a shooting method.
- `spin-up`: J. C. Simo and L. Vu-Quoc (1986); the steady extension in closed form.
- `spaghetti`: J. C. Simo and L. Vu-Quoc (1986); the angular momentum after the loads.
- `right angle`: J. C. Simo and L. Vu-Quoc (1988); digitised from the paper, to 0.5 %.
- `double pendulum`: M. Geradin and A. Cardona (2001), nearly rigid; the rigid mechanism by
  an explicit Runge-Kutta method of order 8 in two angles.
- `four-bar`: P. L. Kinon, P. Betsch and S. R. Eugster (2025); the rigid mechanism.
- `stiff`: a pendulum with EA = 1e6 EI / L^2, and steps far above the periods of its
  stretch; the reference is a run of order 4 with steps that resolve them.
- `long run`: a free beam, the largest changes of energy and momenta in 1e5 steps, with its
  mass centre at rest and far from the origin.

Writes beam_problems.csv.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import harness
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from beam_statics import Row, STATICS

import enerjax as ej


def arc() -> Iterator[Row]:
    points = np.array([[0, 0, 0], [38.2683, -7.61205, 0], [70.7107, -29.2893, 0]])
    section = ej.Section(EA=1e7, GA=41.6667e5, EI=8.333e5, GJ=8.333e5, rhoA=1.0, rhoI=1.0)

    def axis(u):
        shares = [2 * (u - 0.5) * (u - 1), -4 * u * (u - 1), 2 * u * (u - 0.5)]
        return jnp.stack(shares) @ points

    for elements in (8, 16):
        beam = ej.bodies.Beam("beam", axis, section, elements)
        clamp = ej.joints.Fixed("clamp", "ground", beam.start)
        load = ej.forces.ConstantForce("force", beam.end, [0.0, 0.0, 600.0])
        scene = ej.Scene([beam, clamp, load])
        unloaded = scene.args.set("force", force=jnp.zeros(3))
        found = ej.equilibrium(
            scene.system, scene.start(), scene.args, from_args=unloaded, steps=4
        )
        moved = scene.position(found.state, beam.end) - points[2]
        exact = (-23.55478146, 13.57863935, 53.45111098)
        for name, value, reference in zip("xyz", moved, exact, strict=True):
            yield Row("arc", f"{elements} elements", name, float(value), reference)


def spin_up() -> Iterator[Row]:
    section = ej.Section(EA=2.8e7, GA=1e7, EI=1.4e4, rhoA=1.2, rhoI=6e-4)

    def motion(t, args):
        period = 2 * jnp.pi / 15
        early = 0.4 * (t**2 / 2 + (jnp.cos(period * t) - 1) / period**2)
        return jnp.where(t < 15, early, 6 * t - 45)

    for elements in (8, 16):
        beam = ej.bodies.Beam("beam", [[0.0, 0.0], [10.0, 0.0]], section, elements)
        scene = ej.Scene([
            beam,
            ej.joints.Revolute("pin", "ground", beam.start, [0.0, 0.0]),
            ej.drives.Angle("motor", "ground", beam.start, motion),
        ])  # fmt: skip
        system, start, args = scene.build()
        scheme = ej.EnergyMomentumDecaying(0.5)
        sol = ej.simulate(system, scheme, start, args, h=0.01, num_steps=2000)
        tip = scene.position(sol.ys, beam.end)[-300:]
        extension = float(jnp.mean(jnp.linalg.norm(tip, axis=1)) - 10)
        setting = f"{elements} elements, EnergyMomentumDecaying(0.5)"
        yield Row("spin-up", setting, "steady extension", extension, 5.1431746e-4)
        leak = float(jnp.abs(sol.audit.leak).max())
        yield Row("spin-up", setting, "energy not accounted for", leak, 0.0)
        work = float(jnp.sum(sol.audit.drive_work))
        yield Row("spin-up", setting, "work of the drive", work, None)


def spaghetti() -> Iterator[Row]:
    section = ej.Section(EA=1e4, GA=1e4, EI=100.0, rhoA=1.0, rhoI=10.0)
    on = lambda t: jnp.where(t < 2.5, 1.0, 0.0)
    for elements, h in ((16, 0.01), (16, 0.005), (32, 0.005), (64, 0.005)):
        beam = ej.bodies.Beam("beam", [[0.0, 8.0], [6.0, 0.0]], section, elements)
        push = lambda t, args: jnp.stack([8 * on(t), 0 * t])
        turn = lambda t, args: -80 * on(t)
        scene = ej.Scene([
            beam,
            ej.forces.Load("push", beam.end, push),
            ej.forces.TorsionActuator("turn", "ground", beam.end, turn),
        ])  # fmt: skip
        system, start, args = scene.build()
        sol = ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=h, num_steps=round(4 / h)
        )
        angular = np.array([
            _angular_momentum(system, args, q, v)
            for q, v in zip(sol.ys.q[-100:], sol.ys.v[-100:], strict=True)
        ])  # fmt: skip
        setting = f"{elements} elements, h = {h}"
        yield Row("spaghetti", setting, "angular momentum", angular.mean(), -229.515)
        yield Row("spaghetti", setting, "its change", np.ptp(angular), 0.0)


def _angular_momentum(system, args, q, v) -> float:
    momentum = jax.grad(lambda v: system.kinetic_energy(ej.State(q, v), args))(v)
    x, p = q.reshape(-1, 3), momentum.reshape(-1, 3)
    return float(jnp.sum(x[:, 0] * p[:, 1] - x[:, 1] * p[:, 0] + p[:, 2]))


def right_angle() -> Iterator[Row]:
    section = ej.Section(EA=1e6, GA=1e6, EI=1e3, GJ=1e3, rhoA=1.0, rhoI=[20.0, 10.0, 10.0])
    for elements, h in ((4, 0.1), (8, 0.05)):
        first = ej.bodies.Beam("first", [[0, 0, 0], [10.0, 0, 0]], section, elements)
        second = ej.bodies.Beam(
            "second", [[10.0, 0, 0], [10.0, 10.0, 0]], section, elements
        )
        force = lambda t, args: 50 * jnp.clip(1 - jnp.abs(t - 1), 0, 1) * jnp.eye(3)[2]
        scene = ej.Scene([
            first,
            second,
            ej.joints.Fixed("root", "ground", first.start),
            ej.joints.Fixed("elbow", first.end, second.start),
            ej.forces.Load("force", first.end, force),
        ])  # fmt: skip
        system, start, args = scene.build()
        scheme = ej.EnergyMomentumDecaying(0.2)
        sol = ej.simulate(system, scheme, start, args, h=h, num_steps=round(30 / h))
        setting = f"{elements} elements a leg, h = {h}, EnergyMomentumDecaying(0.2)"
        for name, windows in _EXTREMES.items():
            z = np.asarray(scene.position(sol.ys, name)[:, 2])
            for sign, (begin, end), reference in windows:
                within = (sol.ts >= begin) & (sol.ts <= end)
                value = sign * np.max(sign * z[within])
                yield Row("right angle", setting, f"{name} at {begin} to {end} s",
                          float(value), reference)  # fmt: skip


_EXTREMES = {
    "first:end": (
        (1, (2.0, 4.5), 5.50),
        (-1, (5.0, 7.0), 2.48),
        (-1, (9.5, 12.5), -3.87),
    ),
    "second:end": ((1, (6.5, 9.0), 8.29), (-1, (14.5, 17.5), -9.67)),
}


def double_pendulum() -> Iterator[Row]:
    section = ej.Section(EA=1e9, GA=1e9, EI=1e9, rhoA=1.0, rhoI=1e-4)
    first = ej.bodies.Beam("first", [[0.0, 0.0], [1.0, 0.0]], section, 2)
    second = ej.bodies.Beam("second", [[1.0, 0.0], [1.0, -1.0]], section, 2)
    masses = [ej.bodies.PointMass(f"mass {k}", 1.0, q)
              for k, q in enumerate(([1.0, 0.0], [1.0, -1.0]))]  # fmt: skip
    scene = ej.Scene(
        [
            first,
            second,
            *masses,
            ej.joints.Revolute("pin", "ground", first.start, [0.0, 0.0]),
            ej.joints.Revolute("hinge", first.end, second.start),
            ej.joints.Revolute("elbow", "mass 0", first.end),
            ej.joints.Revolute("tip", "mass 1", second.end),
        ],
        gravity=[0.0, -9.81],
    )
    system, start, args = scene.build()
    exact = _rigid_double_pendulum(1.0)
    for h in (2e-3, 1e-3):
        for kind in (ej.EnergyMomentumDecaying, ej.EnergyDecaying):
            scheme = kind(1.0)
            sol = ej.simulate(system, scheme, start, args, h=h, num_steps=round(1 / h))
            tip = np.asarray(scene.position(sol.ys, second.end)[-1])
            error = float(np.abs(tip - exact).max())
            setting = f"h = {h}, {kind.__name__}(1.0)"
            yield Row("double pendulum", setting, "error of the tip", error, 0.0)


def _rigid_double_pendulum(t: float) -> np.ndarray:
    """The tip of two rods with point masses at their ends, which fall from these poses."""
    inertia = 1 / 3 + 1e-4  # of a rod about its end, with that of its sections

    def rates(_, y):
        a, b, va, vb = y  # angles from the horizontal
        coupling = 1.5 * np.cos(a - b)  # (mass / 2 + point mass) lengths
        M = np.array([[inertia + 1 + 2.0, coupling], [coupling, inertia + 1.0]])
        sine = 1.5 * np.sin(a - b)
        weight = -9.81 * np.array([(0.5 + 1 + 2) * np.cos(a), 1.5 * np.cos(b)])
        force = weight + np.array([-sine * vb**2, sine * va**2])
        return [va, vb, *np.linalg.solve(M, force)]

    found = scipy.integrate.solve_ivp(
        rates, (0, t), [0, -np.pi / 2, 0, 0], method="DOP853", rtol=1e-12, atol=1e-12
    )
    a, b = found.y[:2, -1]
    return np.array([np.cos(a) + np.cos(b), np.sin(a) + np.sin(b)])


def four_bar() -> Iterator[Row]:
    """The middle of the coupler after 1 s, of bars that are bent by about a millimetre."""
    pins = np.array([[0.0, 0.0], [2.0, 1.0], [3.5, 1.0], [2.5, 0.0]])
    section = ej.Section.rectangle(
        0.05, 0.05, E=2.1e11, nu=0.3, rho=2710.0, shear_factor=1.0
    )
    names = (("crank", 10), ("coupler", 6), ("rocker", 6))
    bars = crank, coupler, rocker = [
        ej.bodies.Beam(name, pins[k : k + 2], section, elements)
        for k, (name, elements) in enumerate(names)
    ]
    scene = ej.Scene(
        [
            *bars,
            ej.joints.Revolute("A", "ground", crank.start),
            ej.joints.Revolute("B", crank.end, coupler.start),
            ej.joints.Revolute("C", coupler.end, rocker.start),
            ej.joints.Revolute("D", "ground", rocker.end, pins[3]),
        ],
        gravity=[0.0, -9.81],
    )
    system, start, args = scene.build()
    schemes = {
        "EnergyPreserving()": ej.EnergyPreserving(),
        "EnergyMomentumDecaying(0.5)": ej.EnergyMomentumDecaying(0.5),
    }
    for setting, scheme in schemes.items():
        sol = ej.simulate(system, scheme, start, args, h=1e-3, num_steps=1000)
        place = scene.position(sol.ys, coupler.node(3))[-1]
        for name, value, rigid in zip("xy", place, (1.39556674, -0.76494746), strict=True):
            yield Row("four-bar", setting, name, float(value), rigid)
        largest = float(jnp.abs(sol.audit.leak).max() / sol.audit.kinetic.max())
        yield Row("four-bar", setting, "energy that nothing explains", largest, 0.0)


def stiff() -> Iterator[Row]:
    section = ej.Section(EA=1e6, GA=1e6, EI=1.0, rhoA=1.0, rhoI=1e-3)
    beam = ej.bodies.Beam("beam", [[0.0, 0.0], [1.0, 0.0]], section, 4)
    pin = ej.joints.Revolute("pin", "ground", beam.start)
    system, start, args = (scene := ej.Scene([beam, pin], gravity=[0.0, -9.81])).build()

    def run(scheme, h):
        steps = round(1 / h)
        sol = ej.simulate(system, scheme, start, args, h=h, num_steps=steps, throw=False)
        return sol, np.asarray(scene.position(sol.ys, beam.end)[-1])

    _, exact = run(ej.Composed(ej.EnergyPreserving(), 4), 2e-4)
    schemes = {
        "EnergyPreserving()": ej.EnergyPreserving(),
        "EnergyConsistent(0.0)": ej.EnergyConsistent(0.0),
        "EnergyConsistent(1.0)": ej.EnergyConsistent(1.0),
        "EnergyDecaying(1.0)": ej.EnergyDecaying(1.0),
        "EnergyMomentumDecaying(1.0)": ej.EnergyMomentumDecaying(1.0),
    }
    for h in (0.02, 0.0025):
        for name, scheme in schemes.items():
            (sol, tip), setting = run(scheme, h), f"{name}, h = {h}"
            completed = int(sol.stats.completed_steps)
            yield Row("stiff", setting, "steps that have not failed", completed, 1 / h)
            energy, kinetic = (
                np.asarray(x)[: completed + 1]
                for x in (sol.audit.energy, sol.audit.kinetic)
            )
            gain = float(np.diff(energy).max() / kinetic.max())
            yield Row("stiff", setting, "largest gain of energy in a step", gain, 0.0)
            if completed == round(1 / h):
                error = float(np.abs(tip - exact).max())
                yield Row("stiff", setting, "error of the tip", error, 0.0)


def long_run() -> Iterator[Row]:
    section = ej.Section(EA=1e4, GA=1e4, EI=[100.0, 50.0], GJ=40.0, rhoA=1.0, rhoI=0.1)
    beam = ej.bodies.Beam(
        "beam", [[0, 0, 0], [3.0, 0, 4.0]], section, 2, angular_velocity=[0.5, 1.0, 0.2]
    )
    scene = ej.Scene([beam])
    system, at_rest, args = scene.system, scene.start(), scene.args
    momenta = jax.jit(jax.vmap(lambda q, v: _momenta_in_space(system, args, q, v)))
    v = at_rest.v.reshape(-1, 12).at[-1, 0].add(2.0)
    # A third of the mass moves with the velocity 2: two thirds is that of the mass centre.
    for name, velocity in (("at rest", -1 / 3), ("at 4/3", 1.0)):
        start = ej.State(at_rest.q, v.at[:, 0].add(velocity).ravel())
        for steps in (1_000, 10_000, 100_000):
            sol = ej.simulate(
                system, ej.EnergyPreserving(), start, args, h=0.02, num_steps=steps,
                saveat=ej.SaveAt(every=steps // 100),
            )  # fmt: skip
            setting = f"mass centre {name}, {steps} steps"
            energy = np.asarray(sol.audit.energy)[:, None]
            linear, angular = map(np.asarray, momenta(sol.ys.q, sol.ys.v))
            sizes = energy[0, 0], 5.0, np.linalg.norm(angular[0])
            names = "energy", "momentum", "angular momentum"
            for what, x, size in zip(names, (energy, linear, angular), sizes, strict=True):
                change = float(np.abs(x - x[:1]).max() / size)
                yield Row("long run", setting, f"change of {what}, relative", change, 0.0)


def _momenta_in_space(system, args, q, v) -> tuple[jax.Array, jax.Array]:
    """Momentum, and angular momentum about the origin."""
    momentum = jax.grad(lambda v: system.kinetic_energy(ej.State(q, v), args))(v)
    x, p = q.reshape(-1, 4, 3), momentum.reshape(-1, 4, 3)
    return jnp.sum(p[:, 0], axis=0), jnp.sum(jnp.cross(x, p), axis=(0, 1))


PROBLEMS: dict[str, Callable[[], Iterator[Row]]] = {
    **STATICS,
    "arc": arc,
    "spin-up": spin_up,
    "spaghetti": spaghetti,
    "right angle": right_angle,
    "double pendulum": double_pendulum,
    "four-bar": four_bar,
    "stiff": stiff,
    "long run": long_run,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=[*PROBLEMS])
    parser.add_argument("--out", type=Path, default=harness.RESULTS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name, problem in PROBLEMS.items():
        if options.only not in (None, name):
            continue
        for row in problem():
            rows.append(row)
            near = "" if row.reference is None else f" reference {row.reference:.9g}"
            print(f"{row.problem}, {row.setting}: {row.quantity} {row.value:.9g}{near}",
                  flush=True)  # fmt: skip
    harness.write_csv(rows, options.out / "beam_problems.csv")


if __name__ == "__main__":
    main()
