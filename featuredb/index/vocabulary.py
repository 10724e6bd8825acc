"""Visual words that many photos' descriptors have in common, and one vector for each photo made of them.

VLAD (Jegou et al., Aggregating local descriptors into a compact image representation, 2010) over descriptors
reduced by principal components, with residuals of unit length (Delhumeau et al., Revisiting the VLAD image
representation, 2013) and intra-normalisation (Arandjelovic and Zisserman, All about VLAD, 2013).
"""

import hashlib
from dataclasses import dataclass
from importlib import resources
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geometry.arrays import freeze

_SHIPPED = "vocabulary.npz"
_ARRAYS = ("mean", "projection", "words")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vocabulary:
    """Trained once, never changed: vectors of different vocabularies cannot be compared.

    Attributes:
        mean: (128,) float32 of the descriptors.
        projection: (128, d) float32, orthonormal columns: their first principal components.
        words: (k, d) float32 cluster centres of the projected descriptors.
    """

    mean: NDArray[np.float32]
    projection: NDArray[np.float32]
    words: NDArray[np.float32]

    def __post_init__(self) -> None:
        k, d = np.shape(self.words) if np.ndim(self.words) == 2 else (0, 0)
        freeze(self, np.float32, mean=(DESCRIPTOR_SIZE,), projection=(DESCRIPTOR_SIZE, d), words=(k, d))
        if not k or not d:
            raise InvalidValueError("Vocabulary.words: expected (k, d) with k, d > 0, found none")

    @property
    def size(self) -> int:
        """Length of a photo's vector."""
        return self.words.size

    @property
    def digest(self) -> str:
        """16 hex digits that name this vocabulary."""
        content = hashlib.sha256()
        for name in _ARRAYS:
            array = getattr(self, name)
            content.update(repr(array.shape).encode() + array.tobytes())
        return content.hexdigest()[:16]

    def aggregate(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Unit vector (size,) of a photo's descriptors (n, 128); zeros where there are none."""
        total = np.zeros_like(self.words)
        if len(descriptors):
            projected = (descriptors.astype(np.float32) - self.mean) @ self.projection
            half_norm = 0.5 * (self.words**2).sum(axis=1)
            word = np.argmax(projected @ self.words.T - half_norm, axis=1)
            np.add.at(total, word, _unit(projected - self.words[word]))
        vector = _unit(total).ravel()
        return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), dtype=np.float32)


def shipped_vocabulary() -> Vocabulary:
    """The one that comes with featuredb; tools/train_vocabulary.py made it."""
    data = resources.files("featuredb.index").joinpath("data", _SHIPPED).read_bytes()
    with np.load(BytesIO(data), allow_pickle=False) as archive:
        return Vocabulary(**{name: archive[name] for name in _ARRAYS})


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rows of unit length; zeros stay."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, 1e-12), dtype=np.float32)
