"""MuJoCo, which is imported when one of its names is first used.

It is an optional package. The other modules write `mujoco.MjData` and the like.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # Python asks every module for some of these
        raise AttributeError(name)
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Files are read by MuJoCo's parser, which is part of the extra `import`: "
            'python -m pip install "enerjax[import]"'
        ) from error
    return getattr(mujoco, name)
