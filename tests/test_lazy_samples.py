"""Tables of samples that are read row by row behave like the arrays that they stand for."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from ema_pipeline import codec
from ema_pipeline.lazy_samples import CutSamples, LazySamples, StoredSamples

TABLE = np.random.default_rng(0).standard_normal((5, 40))


class Counted(LazySamples):
    """Rows of TABLE that count what is read."""

    def __init__(self) -> None:
        self.shape = (5, 40)
        self.samples_read = 0

    def read(self, row: int, start: int, stop: int) -> np.ndarray:
        self.samples_read += stop - start
        return TABLE[row, start:stop]


@pytest.mark.parametrize(
    "key",
    [
        2,
        -1,
        slice(1, 4),
        slice(None),
        [0, 3],
        (1, slice(5, 9)),
        (slice(0, 2), slice(-7, None)),
        (3, 7),
        (0, -1),
    ],
)
def test_slices_are_those_of_the_array(key: object) -> None:
    assert_array_equal(Counted()[key], TABLE[key])


def test_only_what_is_sliced_is_read() -> None:
    rows = Counted()
    _ = rows[1, 10:14]
    assert rows.samples_read == 4
    _ = CutSamples(rows, [4, 0], 10, 20)[0]
    assert rows.samples_read == 14


def test_cut_rows_of_cut_rows_and_of_arrays_are_the_same_numbers() -> None:
    cut = CutSamples(CutSamples(Counted(), [4, 2, 0], 10, 30), [1, 2], 5, 50)
    assert cut.shape == (2, 15)
    assert_array_equal(cut, TABLE[[2, 0], 15:30])
    assert_array_equal(CutSamples(TABLE, [2, 0], 15, 30), TABLE[[2, 0], 15:30])


def test_rows_are_stored_one_by_one_and_read_back_even_after_the_file_was_closed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        codec.write(file, "table", Counted())
        stored = StoredSamples(file["table"])
        assert_array_equal(stored[1, 3:8], TABLE[1, 3:8])
    assert_array_equal(stored, TABLE)
    with pytest.raises(IndexError):
        stored[5]
