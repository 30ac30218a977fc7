"""Results on disk, chunk by chunk, from which an interrupted sweep can be resumed."""

import json
import os
import time
from pathlib import Path

import numpy as np

from ..._files import read_arrays, write_arrays, write_whole


# A draft that has not been written to for so many seconds belongs to a killed process.
_ABANDONED = 3600


class Store:
    """A folder with the results of one sweep.

    `sweep.json` contains the fingerprint of the sweep, and each chunk is a file `.npz`. A
    process can be killed at any time, because files are written completely or not at all.
    Each chunk contains a checksum of its arrays, so that damage is detected.
    """

    def __init__(self, path: str | os.PathLike, fingerprint: dict[str, str]):
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._clear()
        label = self.path / "sweep.json"
        if not label.exists():
            text = json.dumps(fingerprint, indent=1)
            write_whole(label, lambda file: file.write(text.encode()))
        try:
            found = dict(json.loads(label.read_text()))
        except (ValueError, TypeError):
            raise ValueError(
                f"`path`: {label}, the fingerprint of the sweep in this folder, is "
                "damaged. Choose a new folder, or delete that file if the chunks beside it "
                "certainly belong to this sweep."
            ) from None
        other = [key for key, word in fingerprint.items() if found.get(key) != word]
        if other:
            raise ValueError(
                f"`path`: {self.path} holds another sweep (different: {', '.join(other)}). "
                "To resume that one call `sweep` with the same arguments and the same "
                "versions of the libraries; for a new one choose a new folder."
            )

    def read(self, chunk: int) -> list[np.ndarray] | None:
        """The arrays of a chunk, or `None` if it is not finished.

        **Raises:** `ValueError` if the file is damaged.
        """
        file = self._file(chunk)
        if not file.exists():
            return None
        arrays = read_arrays(file)
        if arrays is None:
            raise ValueError(
                f"`path`: {file} is damaged: its content is not what was written. Delete "
                "the file and call `sweep` again, which repeats this chunk and keeps the "
                "others; if it happens again, check the disk."
            )
        return list(arrays.values())

    def write(self, chunk: int, arrays: list[np.ndarray]) -> None:
        names = (f"arr_{k}" for k in range(len(arrays)))
        write_arrays(self._file(chunk), dict(zip(names, arrays, strict=True)))

    def _file(self, chunk: int) -> Path:
        return self.path / f"chunk-{chunk:06d}.npz"

    def _clear(self) -> None:
        """Removes the drafts of processes that were killed while they wrote."""
        for pattern in (".chunk-*.npz.*", ".sweep.json.*"):
            for draft in self.path.glob(pattern):
                try:
                    if time.time() - draft.stat().st_mtime > _ABANDONED:
                        draft.unlink()
                except FileNotFoundError:
                    pass  # It has been finished, or removed by another process.
