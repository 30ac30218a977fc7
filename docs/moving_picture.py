"""Draws the moving picture of the start page, `docs/pictures/double-pendulum.gif`."""

from pathlib import Path

import enerjax as ej
import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter


PICTURE = Path(__file__).parent / "pictures" / "double-pendulum.gif"
FRAMES_PER_SECOND = 25


def double_pendulum() -> ej.Scene:
    """The scene of the start page."""
    return ej.Scene(
        [
            ej.bodies.PlanarBody.rod("upper", 1.0, [0.0, 0.0], [1.0, 0.0]),
            ej.bodies.PlanarBody.rod("lower", 1.0, [1.0, 0.0], [2.0, 0.0]),
            ej.joints.Revolute("shoulder", "ground", "upper", [0.0, 0.0]),
            ej.joints.Revolute("elbow", "upper", "lower", [0.5, 0.0]),
        ],
        gravity=[0.0, -9.81],
    )


def draw(path: Path, seconds: int = 6) -> None:
    """Writes a run of the double pendulum, beside its energies, as a GIF."""
    jax.config.update("jax_enable_x64", True)
    scene = double_pendulum()
    system, start, args = scene.build()
    steps = seconds * FRAMES_PER_SECOND
    h = 1 / FRAMES_PER_SECOND
    scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, args, h=h, num_steps=steps)
    elbow = np.asarray(scene.position(sol.ys, "lower", [-0.5, 0.0]))
    tip = np.asarray(scene.position(sol.ys, "lower", [0.5, 0.0]))
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
    left.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal", xticks=[], yticks=[])
    (path_of_tip,) = left.plot([], [], color="tab:orange", lw=1)
    (rods,) = left.plot([], [], "o-", color="tab:blue", lw=4, ms=8, solid_capstyle="round")
    audit = sol.audit
    right.set(xlim=(0, seconds), xlabel="time [s]", ylabel="energy [J]")
    energies = {"kinetic": audit.kinetic, "potential": audit.potential}
    energies["total"] = audit.energy
    lines = [right.plot([], [], label=name)[0] for name in energies]
    largest = max(float(np.max(np.abs(x))) for x in energies.values())
    right.set_ylim(-1.1 * largest, 1.1 * largest)
    change = float(np.max(np.abs(audit.energy - audit.energy[0])))
    right.set_title(f"change of the total energy: at most {change:.0e} J", fontsize=10)
    right.legend(loc="lower left")

    def show(k: int) -> None:
        rods.set_data([0.0, elbow[k, 0], tip[k, 0]], [0.0, elbow[k, 1], tip[k, 1]])
        path_of_tip.set_data(*tip[: k + 1].T)
        for line, values in zip(lines, energies.values(), strict=True):
            line.set_data(sol.ts[: k + 1], values[: k + 1])

    path.parent.mkdir(exist_ok=True)
    animation = FuncAnimation(figure, show, frames=range(0, steps + 1))
    animation.save(path, writer=PillowWriter(fps=FRAMES_PER_SECOND), dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    draw(PICTURE)
