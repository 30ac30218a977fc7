"""Imported models beside MuJoCo: the motion, the cost of the first run and of a step.

    python benchmarks/imported_models.py SUITE [FILE ...] [--out FOLDER] [--only NAME]

`SUITE` is the folder of MJCF files of the package `dm_control`, `dm_control/suite`; further
files of MJCF or URDF may follow. Each model starts from a random state (the same in every
run), without contacts, actuators, limits, tendons and fluid, in both programs. The
reference is MuJoCo's own scheme of fourth order. Errors are the largest of the positions of
all mass centres over half a second, in metres: at the step `h`, at half of it, and
extrapolated from both to vanishing steps. Writes imported_models.csv.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import argparse
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import harness
import jax
import mujoco
import numpy as np

import enerjax as ej


SUITE = (
    "pendulum", "acrobot", "cartpole", "reacher", "hopper", "walker", "cheetah", "fish",
    "manipulator", "finger",
)  # fmt: skip
IGNORED = ("actuators", "contacts", "couplings", "fluid", "friction", "limits", "tendons")
END, STEPS = 0.5, 500
# The step of the reference. Light bodies with dampers need it to be so short: explicit
# schemes are unstable with longer ones.
FINE = 1e-5


@dataclasses.dataclass(frozen=True)
class Row:
    """One model; `step_us` is the time of a step, `first_s` that of importing the file and
    of the first run, nearly all of it compilation; both in processor time."""

    model: str
    freedoms: int
    bodies: int
    h: float
    error: float
    error_half: float
    error_extrapolated: float
    peer_error: float
    balance: float
    first_s: float
    step_us: float


def with_start(path: Path, folder: Path) -> Path:
    """A copy of a model with a keyframe, a random state near the pose of the file."""
    spec = mujoco.MjSpec.from_file(str(path))
    for kind in ("meshdir", "texturedir"):
        setattr(spec, kind, str((path.parent / getattr(spec, kind)).resolve()))
    for key in [*spec.keys]:
        spec.delete(key)
    model = spec.compile()
    random, q = np.random.default_rng(0), model.qpos0.copy()
    mujoco.mj_integratePos(model, q, 0.3 * random.normal(size=model.nv), 1.0)
    spec.add_key(name="start", qpos=q, qvel=random.normal(size=model.nv))
    # Rounded by the writer: both programs read the rounded numbers.
    copy = folder / f"{path.parent.name}-{path.stem}.xml"
    copy.write_text(spec.to_xml())
    return copy


def motion_of_peer(path: Path, step: float) -> tuple[Any, np.ndarray]:
    """The model, and the mass centres of all its bodies at the end of each step of 1 ms."""
    model = mujoco.MjModel.from_xml_path(str(path))
    bits = mujoco.mjtDisableBit
    model.opt.disableflags |= (
        bits.mjDSBL_CONSTRAINT | bits.mjDSBL_ACTUATION | bits.mjDSBL_CONTACT
    )
    model.opt.density = model.opt.viscosity = 0.0
    for of_tendons in (model.tendon_stiffness, model.tendon_damping):
        of_tendons[:] = 0.0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = step
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    rows = [data.xipos.copy()]
    for _ in range(STEPS):
        for _ in range(round(END / STEPS / step)):
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        rows.append(data.xipos.copy())
    return model, np.array(rows)


def measure(path: Path, folder: Path) -> Row:
    copy = with_start(path, folder)
    model, wanted = motion_of_peer(copy, FINE)
    _, finer = motion_of_peer(copy, FINE / 2)
    begin = harness.clock()
    scene = ej.scenes.from_mjcf(copy, keyframe="start", ignore=IGNORED)
    system, start, args = scene.build()
    h = END / STEPS

    def run(state: ej.State, h: float) -> ej.Solution:
        scheme = ej.EnergyPreserving()
        sol = ej.simulate(system, scheme, state, args, h=h, num_steps=STEPS)
        return jax.block_until_ready(sol)

    whole = run(start, h)
    first = harness.clock() - begin
    halves = [run(start, h / 2)]
    begin = harness.clock()
    halves.append(run(halves[0].end, h / 2))
    step = (harness.clock() - begin) / STEPS
    moving = [k for k in range(1, model.nbody) if _has_joints(model, k)]
    points = _points(scene, start, model, moving, wanted[0])
    coarse = _motion(scene, whole.ys, model, points)
    both = [_motion(scene, sol.ys, model, points) for sol in halves]
    half = np.concatenate([both[0][::2], both[1][2::2]])
    wanted, finer = wanted[:, moving], finer[:, moving]
    largest = lambda x: float(np.abs(x - finer).max())
    audit = whole.audit
    balance = np.diff(audit.energy) - audit.work[1:]
    return Row(
        model=copy.stem.removeprefix("suite-"),
        freedoms=int(model.nv),
        bodies=len(moving),
        h=h,
        error=largest(coarse),
        error_half=largest(half),
        error_extrapolated=largest((4 * half - coarse) / 3),
        peer_error=largest(wanted),
        balance=float(np.abs(balance).max() / audit.kinetic.max()),
        first_s=first,
        step_us=1e6 * step,
    )


def _has_joints(model: Any, body: int) -> bool:
    return bool(model.body_dofnum[body])


def _points(
    scene: ej.Scene, start: ej.State, model: Any, moving: list[int], centres: np.ndarray
) -> dict[int, np.ndarray]:
    """The mass centres of bodies of the file in the frames of those of the scene, to which
    others may be attached."""
    poses = {body.name: body for body in scene.motion(start).bodies}
    found = {}
    for k in moving:
        pose = poses[_name(model, k)]
        found[k] = (centres[k] - pose.position[0]) @ pose.rotation[0]
    return found


def _name(model: Any, body: int) -> str:
    return model.body(body).name or f"body {body}"


def _motion(
    scene: ej.Scene, ys: ej.State, model: Any, points: dict[int, np.ndarray]
) -> np.ndarray:
    places = [scene.position(ys, _name(model, k), x) for k, x in points.items()]
    return np.stack([np.asarray(place) for place in places], axis=1)


def show(rows: list[Row]) -> None:
    line = "{:20} {:>8} {:>7} {:>10} {:>10} {:>12} {:>10} {:>9} {:>8} {:>8}"
    print(
        line.format(
            "model", "freedoms", "bodies", "error", "half step", "extrapolated",
            "reference", "balance", "first s", "us/step",
        )
    )  # fmt: skip
    for r in rows:
        errors = r.error, r.error_half, r.error_extrapolated, r.peer_error, r.balance
        told = [f"{x:.1e}" for x in errors]
        costs = f"{r.first_s:.1f}", f"{r.step_us:.0f}"
        print(line.format(r.model, r.freedoms, r.bodies, *told, *costs))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("suite", type=Path)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--only", choices=SUITE)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    names = [options.only] if options.only else SUITE
    paths = [options.suite / f"{name}.xml" for name in names] + options.files
    rows = []
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for path in paths:
            rows.append(measure(path, Path(folder)))
            show(rows[-1:])
            # The next model may take long.
            harness.write_csv(rows, options.out / "imported_models.csv")
    show(rows)


if __name__ == "__main__":
    main()
