"""Where the schemes hold: at rest, far from the origin, at the ends of every scale."""

import numpy as np
import pytest

import enerjax as ej


def settling(gravity):
    """A rod on a torsion spring that a damper brings to rest away from angle zero."""
    forces = ej.forces
    parts = [
        ej.bodies.PlanarBody.rod("rod", 1.0, [0.0, 0.0], [1.0, 0.0]),
        ej.joints.Revolute("pin", "ground", "rod", [0.0, 0.0]),
        forces.TorsionSpring("spring", "ground", "rod", 20.0, 0.4),
        forces.TorsionDamper("damper", "ground", "rod", 5.0),
    ]
    return ej.Scene(parts, gravity=[0.0, -gravity]).build()


@pytest.mark.parametrize("scheme", [ej.EnergyDecaying(0.5), ej.EnergyConsistent(0.5)])
def test_motion_that_dies_out_away_from_zero_stays_at_rest(scheme):
    """Where terms cancel, what is left of the forces is round-off, not motion."""
    for gravity in (0.0, 9.81):
        system, start, args = settling(gravity)
        sol = ej.simulate(system, scheme, start, args, h=0.1, num_steps=1500, throw=False)
        assert sol.stats.completed_steps == 1500
        angle = float(sol.ys.q[-1, 2])
        # The rod is 0.5 from its pin to its mass centre. Round-off.
        torque = 20.0 * (angle - 0.4) + 0.5 * gravity * np.cos(angle)
        assert abs(torque) <= 1e-13
        assert np.max(np.abs(sol.ys.v[-1])) <= 1e-13
