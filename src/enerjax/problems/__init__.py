"""The paper's test cases and benchmark mechanisms, as `(system, start, args)`.

Each function builds a `Problem`; calls with other numbers share one compiled program. Units
are SI unless stated. In the plane gravity acts along +y, for mechanisms along -y, and in
space along -z.
"""

from ._base import Problem as Problem
from ._mechanisms import (
    four_bar as four_bar,
    parallel_bars as parallel_bars,
    point_pendulum as point_pendulum,
    slider_crank as slider_crank,
    spatial_four_bar as spatial_four_bar,
    squeezer as squeezer,
    steady_top as steady_top,
    tethered_body as tethered_body,
)
from ._particles import (
    fput as fput,
    henon_heiles as henon_heiles,
    kepler as kepler,
    pleiades as pleiades,
)
from ._pendulums import (
    chain as chain,
    double_pendulum as double_pendulum,
    double_pendulum_angles as double_pendulum_angles,
    pendulum as pendulum,
    pendulum_angle as pendulum_angle,
    stiff_double_pendulum as stiff_double_pendulum,
)
from ._rigid_bodies import (
    free_rigid_body as free_rigid_body,
    heavy_top as heavy_top,
    heavy_top_canonical as heavy_top_canonical,
    heavy_top_directors as heavy_top_directors,
)
from ._springs import (
    car_axis as car_axis,
    elastic_pendulum as elastic_pendulum,
    four_particles as four_particles,
    spring_pendulum as spring_pendulum,
    spring_ring as spring_ring,
)
