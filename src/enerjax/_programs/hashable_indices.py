import numpy as np


class Indices:
    """Known indices, compared by value, so that equal systems share compiled programs."""

    def __init__(self, array: np.ndarray):
        self.array = array
        self._key = array.shape, array.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Indices) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
