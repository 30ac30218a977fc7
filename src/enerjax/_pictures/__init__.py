"""Pictures: axes, polygons and lines in the plane and in space, and films.

This room knows no mechanics. It imports matplotlib, so it is itself imported only where a
picture is made.
"""

from .animation import Animation as Animation, frame_times as frame_times
from .axes import (
    axes_of as axes_of,
    grid_of as grid_of,
    headline as headline,
    label as label,
    legend_above as legend_above,
    tell as tell,
    Units as Units,
)
from .canvas import (
    AbstractCanvas as AbstractCanvas,
    color_of as color_of,
    Drawing as Drawing,
    Faces as Faces,
    Path as Path,
)
from .film import (
    canvas_of as canvas_of,
    film as film,
    joint_bounds as joint_bounds,
    Trail as Trail,
)
from .geometry import (
    as_quadrilaterals as as_quadrilaterals,
    straight as straight,
    tube as tube,
)
from .symbols import (
    GREY as GREY,
    PlaneSymbols as PlaneSymbols,
    SpaceSymbols as SpaceSymbols,
)
