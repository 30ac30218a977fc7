"""Results on disk, chunk by chunk: a sweep that was killed goes on where it stopped."""

import io
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .checksums import checksum


# Seconds after which a draft that nobody writes to is what a killed process left.
_ABANDONED = 3600


class Store:
    """A folder of one sweep: `sweep.json` tells which, each chunk is a file `.npz`.

    Files appear whole or not at all, so that a process can be killed at any time; each
    chunk holds a checksum of its arrays, so that later damage is found.
    """

    def __init__(self, path: str | os.PathLike, fingerprint: dict[str, str]):
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._clear()
        label = self.path / "sweep.json"
        if not label.exists():
            text = json.dumps(fingerprint, indent=1)
            self._put(label, lambda file: file.write(text.encode()))
        try:
            found = dict(json.loads(label.read_text()))
        except (ValueError, TypeError):
            raise ValueError(
                f"`path`: {label}, which tells what sweep the folder holds, is damaged. "
                "Give a new folder, or delete that file if the chunks beside it are "
                "certainly of the sweep that is called now."
            ) from None
        other = [key for key, word in fingerprint.items() if found.get(key) != word]
        if other:
            raise ValueError(
                f"`path`: {self.path} holds another sweep (different: {', '.join(other)}). "
                "To go on with that one call `sweep` as it was called, with the versions "
                "of the libraries that it was made with; for a new one give a new folder."
            )

    def read(self, chunk: int) -> list[np.ndarray] | None:
        """The arrays of a chunk, or `None` where it is not done.

        **Raises:** `ValueError` where the file is damaged.
        """
        file = self._file(chunk)
        if not file.exists():
            return None
        data = file.read_bytes()
        try:
            with np.load(io.BytesIO(data)) as content:
                arrays = [content[f"arr_{k}"] for k in range(len(content.files) - 1)]
                is_whole = str(content["sha256"]) == checksum(arrays)
        # (A damaged archive raises errors of a dozen types.)
        except Exception:
            is_whole, arrays = False, []
        if not is_whole:
            raise ValueError(
                f"`path`: {file} is damaged: its content is not what was written. Delete "
                "the file and call `sweep` again, which makes this chunk anew and keeps "
                "the others; if it happens again, look at the disk."
            )
        return arrays

    def write(self, chunk: int, arrays: list[np.ndarray]) -> None:
        word = np.array(checksum(arrays))
        self._put(self._file(chunk), lambda file: np.savez(file, *arrays, sha256=word))

    def _file(self, chunk: int) -> Path:
        return self.path / f"chunk-{chunk:06d}.npz"

    def _put(self, target: Path, write: Callable[[BinaryIO], Any]) -> None:
        # Beside its place, under a name of this process: `replace` is atomic only within
        # one file system, and others may write the same label.
        draft = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            with draft.open("wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(target)
        finally:
            draft.unlink(missing_ok=True)

    def _clear(self) -> None:
        """Remove what processes left that were killed while they wrote."""
        for pattern in (".chunk-*.npz.*", ".sweep.json.*"):
            for draft in self.path.glob(pattern):
                try:
                    if time.time() - draft.stat().st_mtime > _ABANDONED:
                        draft.unlink()
                except FileNotFoundError:
                    pass  # Its process has finished it, or another has removed it.
