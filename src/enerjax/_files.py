"""Files of named arrays, which are written completely or not at all."""

import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ._programs import checksum


_CHECKSUM = "sha256"


def write_whole(target: Path, write: Callable[[BinaryIO], Any]) -> None:
    """Calls `write(file)`. A process that is killed meanwhile leaves the old file."""
    # The draft is in the same folder, because `replace` is atomic only within one file
    # system. Its name contains the process, because others may write the same file.
    draft = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with draft.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def write_arrays(target: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes an archive `.npz` of arrays without Python objects, and a checksum of them."""
    content: Any = {**arrays, _CHECKSUM: np.array(checksum(arrays.values()))}
    write_whole(target, lambda file: np.savez(file, **content))


def read_arrays(source: Path) -> dict[str, np.ndarray] | None:
    """The arrays of `write_arrays` in their order, or `None` if the file is damaged."""
    data = source.read_bytes()
    try:
        with np.load(io.BytesIO(data)) as content:
            arrays = {name: content[name] for name in content.files}
            is_whole = str(arrays.pop(_CHECKSUM)) == checksum(arrays.values())
    # A damaged archive raises errors of a dozen types.
    except Exception:
        return None
    return arrays if is_whole else None
