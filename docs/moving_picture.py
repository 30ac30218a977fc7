"""Draws the moving picture of the start page, `docs/pictures/double-pendulum.gif`."""

from pathlib import Path

import jax

import enerjax as ej


PICTURE = Path(__file__).parent / "pictures" / "double-pendulum.gif"


def draw(path: Path, num_steps: int = 250) -> None:
    """Writes a film of the run of the start page."""
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
    scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, args, h=0.02, num_steps=num_steps)
    film = scene.animate(sol, fps=20.0, traces=[("lower", [0.5, 0.0])], energy=True)
    film.save(path)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    draw(PICTURE)
