"""What a reader hands back: channels as the file holds them, unscaled."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.units import find_unit

if TYPE_CHECKING:
    import h5py

FULL_SCALE = "fraction of full scale"
"""Stands in place of a unit where samples are fractions of the converter's range (integer WAV)."""


class StoredFile(threading.local):
    """An HDF5 file of which channels are read; opened for each read, or once for many of a thread in `held_open`.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._open: h5py.File | None = None

    @contextmanager
    def held_open(self) -> Iterator[None]:
        """While the block is open, so is the file: opening it takes as long as reading a channel.

        Raises
        ------
        EmaError
            If the file cannot be opened.
        """
        import h5py

        try:
            file = h5py.File(self.path, "r")
        except OSError as error:
            raise self._damaged("", error) from None
        with file:
            before, self._open = self._open, file
            try:
                yield
            finally:
                self._open = before

    def read(self, name: str, cut: slice) -> NDArray[np.float64]:
        """Some samples of a one-dimensional dataset."""
        import h5py

        try:
            if self._open is not None:
                return np.asarray(self._open[name][cut], dtype=np.float64)
            with h5py.File(self.path, "r") as file:
                return np.asarray(file[name][cut], dtype=np.float64)
        except (OSError, KeyError) as error:
            raise self._damaged(f"dataset '{name}' ", error) from None

    def _damaged(self, what: str, error: Exception) -> EmaError:
        return EmaError(
            f"{self.path}: {what}cannot be read ({error}); the file is damaged, copy or export it again"
        )


@dataclass(frozen=True)
class StoredSamples:
    """A channel that stays in its HDF5 file until it is sliced or made an array.

    Attributes
    ----------
    file : StoredFile
    name : str
        Path of a one-dimensional dataset within the file.
    size : int
    """

    file: StoredFile
    name: str
    size: int

    def __getitem__(self, cut: slice) -> NDArray[np.float64]:
        return self.file.read(self.name, cut)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)


Samples = NDArray[np.float64] | StoredSamples


def held_open(samples: Samples) -> AbstractContextManager[None]:
    """The file in which samples and those of the channels beside them are stored, held open; nothing for an array."""
    return samples.file.held_open() if isinstance(samples, StoredSamples) else nullcontext()


@dataclass(frozen=True)
class RawChannel:
    """One channel as its file holds it.

    Attributes
    ----------
    samples : ndarray or StoredSamples, (n_samples,)
        In `unit`; NaN where the file says so.
    unit : str or None
        As the file spells it, None where it is silent, `FULL_SCALE` for integer WAV.
    dof : str or None
        Hint such as ``"12.z"``, for drafting a description only.
    reference : str or None
        The same of what drives the structure: where the hammer strikes.
    """

    samples: Samples
    unit: str | None = None
    dof: str | None = None
    reference: str | None = None


@dataclass(frozen=True)
class RawRecord:
    """One record file as a reader understands it.

    Attributes
    ----------
    channels : dict
        Channel name to `RawChannel`, in the order of the file.
    sample_rate_hz : float or None
        None where the file is silent.
    notes : tuple of str
        What the reader had to decide, one plain sentence each.
    rate_tolerance : float
        Relative uncertainty of the sample rate where it comes from rounded times.
    seconds_assumed : bool
        True where it comes from times of no stated unit.
    """

    channels: dict[str, RawChannel]
    sample_rate_hz: float | None = None
    notes: tuple[str, ...] = ()
    rate_tolerance: float = 0.0
    seconds_assumed: bool = False

    def in_memory(self) -> RawRecord:
        """The same with all samples read, for a file that will not stay."""
        channels = {name: replace(c, samples=np.asarray(c.samples)) for name, c in self.channels.items()}
        return replace(self, channels=channels)


def split_unit(label: str) -> tuple[str, str | None]:
    """Split a label such as ``"hammer [N]"`` or ``"hammer, N"`` into name and unit; only known units count.

    >>> split_unit("hammer (N)")
    ('hammer', 'N')
    """
    for pattern in (r"\s*(.*?\S)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]\s*", r"\s*(.*?\S)\s*,\s*(\S+)\s*"):
        match = re.fullmatch(pattern, label)
        if match and find_unit(match[2]) is not None:
            return match[1], match[2]
    return label.strip(), None


def clean_unit(text: object) -> str | None:
    """Return a unit label as text, or None where it only fills a field (``NONE``, ``-``, ``EU``)."""
    if isinstance(text, bytes):
        text = text.decode("utf-8", errors="replace")
    label = str(text).strip() if text is not None else ""
    return None if label.casefold() in {"", "none", "-", "eu", "n/a", "unknown", "arb", "a.u."} else label
