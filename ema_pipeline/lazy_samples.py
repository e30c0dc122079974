"""Tables of samples that are read row by row: one record of many channels can be larger than the memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.files import reason

if TYPE_CHECKING:
    import h5py

Real = NDArray[np.float64]


class LazySamples(ABC):
    """Samples of several channels, (n_rows, n_samples), that are read where they are sliced.

    ``rows[k]``, ``rows[k, a:b]``, ``rows[2:4]`` and ``numpy.asarray(rows)`` give arrays, as those of an array
    do; nothing is kept.

    Attributes
    ----------
    shape : tuple of int
        (n_rows, n_samples)
    """

    shape: tuple[int, int]

    def held_open(self) -> AbstractContextManager[None]:
        """Keeps what the samples are read from open while many rows are read."""
        return nullcontext()

    @abstractmethod
    def read(self, row: int, start: int, stop: int) -> Real:
        """Samples ``start:stop`` of one row, (stop - start,)."""

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Real:
        row, cut = key if isinstance(key, tuple) else (key, slice(None))
        samples = range(self.shape[1])[cut]
        if isinstance(samples, int):
            return self[row, samples : samples + 1][..., 0]
        chosen = np.arange(self.shape[0])[row]
        if chosen.ndim == 0:
            return self.read(int(chosen), samples.start, samples.stop)[:: samples.step]
        out = np.empty((chosen.size, len(samples)))
        for place, index in enumerate(chosen):
            out[place] = self.read(int(index), samples.start, samples.stop)[:: samples.step]
        return out

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)


class CutSamples(LazySamples):
    """Some rows of a table, from one sample to another.

    Parameters
    ----------
    whole : LazySamples or ndarray, (n_rows, n_samples)
    keep : list of int
    start, stop : int
    """

    def __init__(self, whole: LazySamples | Real, keep: list[int], start: int, stop: int) -> None:
        self._whole, self._keep, self._start = whole, keep, start
        self.shape = (len(keep), min(stop, whole.shape[1]) - start)

    def read(self, row: int, start: int, stop: int) -> Real:
        """Samples ``start:stop`` of one of the rows kept."""
        return np.asarray(self._whole[self._keep[row], self._start + start : self._start + stop])


class StoredSamples(LazySamples):
    """A two-dimensional dataset of an HDF5 file; once the file is closed, each read opens it again.

    Parameters
    ----------
    dataset : h5py.Dataset
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._path, self._name = dataset.file.filename, dataset.name
        self.shape = dataset.shape

    def read(self, row: int, start: int, stop: int) -> Real:
        """Samples ``start:stop`` of one row."""
        if self._dataset:
            return np.asarray(self._dataset[row, start:stop])
        import h5py

        try:
            with h5py.File(self._path, "r") as file:
                return np.asarray(file[self._name][row, start:stop])
        except (OSError, KeyError) as error:
            raise EmaError(f"{self._path}: is damaged ({reason(error)}); delete it and run again") from None
