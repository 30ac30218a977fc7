"""MuJoCo, which is imported when something of it is first used.

It is an optional package. The other modules write `mujoco.MjData` and the like.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # of Python's own, which asks any module for some
        raise AttributeError(name)
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Files are read by MuJoCo's parser, which is part of the extra `import`: "
            'python -m pip install "enerjax[import]"'
        ) from error
    return getattr(mujoco, name)
