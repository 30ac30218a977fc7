"""Pictures: axes, polygons and lines in the plane and in space, and films.

This room imports matplotlib, so it is imported only where a picture is made.
"""

from .animation import Animation as Animation, frame_times as frame_times
from .axes import (
    axes_of as axes_of,
    checked as checked,
    clock as clock,
    grid_of as grid_of,
    in_space as in_space,
    label as label,
    legend_above as legend_above,
    tell as tell,
    Units as Units,
)
from .canvas import (
    AbstractCanvas as AbstractCanvas,
    color_of as color_of,
    Dot as Dot,
    Drawing as Drawing,
    Faces as Faces,
    Path as Path,
    PlaneCanvas as PlaneCanvas,
    SpaceCanvas as SpaceCanvas,
)
