"""Results on disk, chunk by chunk: a sweep that was killed goes on where it stopped."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np


class Store:
    """A folder of one sweep: `sweep.json` tells which, each chunk is a file `.npz`.

    Files appear whole or not at all, so that a process can be killed at any time.
    """

    def __init__(self, path: str | os.PathLike, fingerprint: dict[str, str]):
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        label = self.path / "sweep.json"
        if not label.exists():
            text = json.dumps(fingerprint, indent=1)
            self._put(label, lambda file: file.write(text.encode()))
        try:
            found = json.loads(label.read_text())
        except ValueError:
            found = {}
        other = [key for key, word in fingerprint.items() if found.get(key) != word]
        if other:
            raise ValueError(
                f"`path`: {self.path} holds another sweep (different: {', '.join(other)}). "
                "To go on with that one call `sweep` as it was called, with the versions "
                "of the libraries that it was made with; for a new one give a new folder."
            )

    def read(self, chunk: int) -> list[np.ndarray] | None:
        """The arrays of a chunk, or `None` where it is not done."""
        file = self._file(chunk)
        if not file.exists():
            return None
        with np.load(file) as arrays:
            return [arrays[f"arr_{k}"] for k in range(len(arrays.files))]

    def write(self, chunk: int, arrays: list[np.ndarray]) -> None:
        self._put(self._file(chunk), lambda file: np.savez(file, *arrays))

    def _file(self, chunk: int) -> Path:
        return self.path / f"chunk-{chunk:06d}.npz"

    def _put(self, target: Path, write: Callable[[BinaryIO], Any]) -> None:
        # Beside its place, under a name of this process: `replace` is atomic only within
        # one file system, and others may write the same label.
        draft = target.with_name(f".{target.name}.{os.getpid()}")
        with draft.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(target)
