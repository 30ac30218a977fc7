"""Draws the moving picture of the start page, `docs/pictures/double-pendulum.gif`."""

from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

import enerjax as ej


PICTURE = Path(__file__).parent / "pictures" / "double-pendulum.gif"
FRAMES_PER_SECOND = 20
STEPS_PER_FRAME = 2


def draw(path: Path, frames: int = 100) -> None:
    """Writes a run of the mechanism of the start page, beside its energies."""
    scene = ej.Scene(
        [
            ej.bodies.PlanarBody.rod("upper", 1.0, [0.0, 0.0], [1.0, 0.0]),
            ej.bodies.PlanarBody.rod("lower", 1.0, [1.0, 0.0], [2.0, 0.0]),
            ej.joints.Revolute("shoulder", "ground", "upper", [0.0, 0.0]),
            ej.joints.Revolute("elbow", "upper", "lower", [0.5, 0.0]),
        ],
        gravity=[0.0, -9.81],
    )
    system, start, args = scene.build()
    h, num_steps = 1 / (FRAMES_PER_SECOND * STEPS_PER_FRAME), frames * STEPS_PER_FRAME
    scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, args, h=h, num_steps=num_steps)
    ends = [scene.position(sol.ys, "lower", [x, 0.0]) for x in (-0.5, 0.5)]
    joints = np.stack([np.zeros_like(ends[0]), *ends])  # shoulder, elbow, tip
    energies = {"kinetic": sol.audit.kinetic, "potential": sol.audit.potential}
    energies["total"] = sol.audit.energy

    figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 3.6))
    figure.subplots_adjust(0.01, 0.14, 0.98, 0.9, wspace=0.22)
    left.set(xlim=(-2.1, 2.1), ylim=(-2.2, 1.2), aspect="equal")
    left.set_axis_off()
    trace = left.plot([], [], color="tab:orange", lw=1)[0]
    rods = left.plot([], [], "o-", color="tab:blue", lw=5, solid_capstyle="round")[0]
    lines = {name: right.plot([], [], label=name)[0] for name in energies}
    right.set(xlim=(0.0, num_steps * h), ylim=(-30.0, 22.0))
    right.set(xlabel="time [s]", ylabel="energy [J]")
    change = float(np.max(np.abs(energies["total"] - energies["total"][0])))
    right.set_title(f"the total changes by {change:.0e} J", fontsize=10)
    right.legend(loc="lower center", ncols=3, frameon=False)

    def show(frame: int) -> None:
        row = frame * STEPS_PER_FRAME
        rods.set_data(*joints[:, row].T)
        trace.set_data(*joints[-1, : row + 1].T)
        for name, line in lines.items():
            line.set_data(sol.ts[: row + 1], energies[name][: row + 1])

    animation = FuncAnimation(figure, show, frames=frames + 1)
    animation.save(path, writer=PillowWriter(fps=FRAMES_PER_SECOND), dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    draw(PICTURE)
