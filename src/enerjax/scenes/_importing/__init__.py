"""Scenes from files in the formats MJCF and URDF, which MuJoCo's parser reads."""

from .files import from_mjcf as from_mjcf, from_urdf as from_urdf
