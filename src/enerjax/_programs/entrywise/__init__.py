"""Programs of small systems for many lanes, entry by entry.

Every number of a lane is a vector over the lanes. Operations on structural zeros and known
numbers are left out, and loops over lanes use all entries of a vector register.
"""

from .lanes import (
    in_lanes as in_lanes,
    known_zeros as known_zeros,
    ProgramInLanes as ProgramInLanes,
)
