"""From named arrays, as HDF5, MAT and TDMS files hold them, to channels and a sample rate."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.raw import RawChannel, RawRecord, Samples, StoredSamples, clean_unit
from ema_pipeline.ingest.readers.timebase import (
    is_time_name,
    is_uniform_ramp,
    rate_from_times,
    time_unit_scale,
    whole_rate,
)

_RATE_KEYS = {
    "samplerate", "sampleratehz", "samplingrate", "samplingratehz", "fs", "fshz", "sr", "samplefrequency",
    "samplefreq", "samplefrequencyhz", "samplingfrequency", "samplingfrequencyhz", "samplingfreq",
}  # fmt: skip
_STEP_KEYS = {"dt", "dts", "deltat", "ts", "wfincrement", "timestep", "samplinginterval", "sampleinterval"}
_UNIT_KEYS = {"unit", "units", "unitstring", "niunitdescription", "engineeringunits", "ylabelunit"}
_NAME_KEYS = {"channels", "channelnames", "names", "labels", "columns", "channelname"}
_FEWEST_SAMPLES = 16
"""What holds fewer values is no record."""

_DOF_KEYS = {"dof", "location"}


@dataclass(frozen=True)
class NamedArray:
    """An array (or scalar, or list of texts) that a file holds under a path.

    Attributes
    ----------
    path : tuple of str
        Groups or structs, then the name.
    values : ndarray or StoredSamples
        Any shape.
    attributes : mapping
        What the file says about it.
    """

    path: tuple[str, ...]
    values: NDArray[Any] | StoredSamples
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.path[-1]


@dataclass(frozen=True)
class _Column:
    """One vector on its way to becoming a channel.

    `axis_rate` where it came with its own axis; `matrix` is the path of the matrix that it is a column of.
    """

    path: tuple[str, ...]
    samples: Samples
    attributes: Mapping[str, Any]
    axis_rate: float | None = None
    matrix: tuple[str, ...] | None = None


def assemble(
    arrays: Sequence[NamedArray],
    attributes: Mapping[str, Mapping[str, Any]] | None = None,
    limits: ReadLimits | None = None,
) -> RawRecord:
    """Sort named arrays into channels, time axes and sample rates.

    Vectors are channels; the columns of a matrix (its longer side is time) become ``NAME_1``, ``NAME_2``
    … unless the file names them. A matrix whose first column is an even axis holds that axis and its
    values. Complex arrays and texts are no channels.

    Raises
    ------
    EmaError
        Where the file contradicts itself about the sample rate, or holds more channels than anybody measures.
    """
    limits = limits or ReadLimits()
    rates = _Rates()
    for source, stated in (attributes or {}).items():
        rates.read(source, stated)
    column_names: tuple[str, ...] = ()
    unit_names: tuple[str, ...] = ()
    columns: list[_Column] = []
    notes: list[str] = []
    for array in arrays:
        label = "/".join(array.path)
        values = array.values
        if isinstance(values, StoredSamples):
            rates.read(label, array.attributes)
            columns.append(_Column(array.path, values, array.attributes))
            continue
        values = np.squeeze(np.asarray(values))
        if values.dtype.kind in "USO":
            if _key(array.name) in _NAME_KEYS:
                column_names = _texts(values)
            if _key(array.name) in _UNIT_KEYS:
                unit_names = _texts(values)
            elif values.size >= _FEWEST_SAMPLES:
                notes.append(f"'{label}' holds text and is left out")
            continue
        if values.dtype.kind == "c":
            notes.append(f"'{label}' is complex (a spectrum?) and is left out")
            continue
        if values.dtype.kind not in "fiu" or values.size == 0:
            continue
        if values.ndim == 0:
            rates.read(label, {array.name: values})
            continue
        rates.read(label, array.attributes)
        numbers = values.astype(np.float64, copy=False)
        if values.ndim == 1 and is_time_name(array.name):
            scale = time_unit_scale(array.name, _text(array.attributes, _UNIT_KEYS))
            rates.add(label, *rate_from_times(numbers * (scale or 1.0)), assumed=scale is None)
        elif values.ndim == 1:
            columns.append(_Column(array.path, numbers, array.attributes))
        elif values.ndim == 2:
            limits.check_channels(min(values.shape))
            columns.extend(_split_matrix(array, numbers))
        else:
            notes.append(f"'{label}' has {values.ndim} dimensions and is left out")
    limits.check_channels(len(columns))
    columns = _without_housekeeping(columns, notes)
    columns, axis_rate = _one_axis(columns, rates.value, notes)
    rates.add("axis columns", axis_rate, assumed=True)
    unit_names = _listed(unit_names, columns)
    names = _listed(column_names, columns) or _shortest_unique([c.path for c in columns])
    channels = {
        name: RawChannel(
            samples=column.samples,
            unit=clean_unit(_text(column.attributes, _UNIT_KEYS) or (unit_names[i] if unit_names else None)),
            dof=clean_unit(_text(column.attributes, _DOF_KEYS)),
        )
        for i, (name, column) in enumerate(zip(names, columns, strict=True))
    }
    if len(channels) < len(columns):
        raise EmaError("two channels have the same name; rename one in the file")
    return RawRecord(channels, rates.value, tuple(notes), rates.tolerance, rates.assumed)


class _Rates:
    """Collects what a file says about its sample rate and refuses contradictions."""

    def __init__(self) -> None:
        self.value: float | None = None
        self.tolerance = 0.0
        self.assumed = False
        self._source = ""

    def read(self, label: str, attributes: Mapping[str, Any]) -> None:
        for key, raw in attributes.items():
            plain = _key(key)
            if plain not in _RATE_KEYS | _STEP_KEYS:
                continue
            number = np.ravel(np.asarray(raw))
            if number.size != 1 or (number.dtype.kind not in "fiu" and not plain.startswith("sampl")):
                continue  # short keys may mean something else
            text = _texts(number)[0][:40]
            value = _number_of(text)
            if not value > 0:
                if not plain.startswith("sampl") or not text:
                    continue
                raise EmaError(
                    f"states {key} = '{text}' ({label}), which is no sample rate; correct or remove it"
                )
            self.add(label, value if plain in _RATE_KEYS else whole_rate(value, 1e-9))

    def add(self, label: str, rate: float | None, tolerance: float = 0.0, *, assumed: bool = False) -> None:
        if rate is None:
            return
        if self.value is not None and abs(rate / self.value - 1) > max(1e-4, tolerance, self.tolerance):
            raise EmaError(
                f"contradicts itself: sample rate {self.value:.10g} Hz ({self._source}) "
                f"and {rate:.10g} Hz ({label}); correct the file"
            )
        self.assumed = assumed and (self.value is None or self.assumed)
        if self.value is None or tolerance < self.tolerance:
            self.value, self.tolerance, self._source = rate, tolerance, label


def _listed(texts: tuple[str, ...], columns: list[_Column]) -> tuple[str, ...]:
    """The texts of a list beside a matrix, one for each of its columns; none where nothing says what they belong to.

    Variables of their own come in the order of their file, which need not be that of a list.
    """
    if len({c.matrix for c in columns}) != 1 or columns[0].matrix is None:
        return ()
    if columns[0].axis_rate is not None and len(texts) == len(columns) + 1:
        texts = texts[1:]  # the first is that of the axis
    return texts if len(texts) == len(columns) and all(texts) else ()


def _number_of(text: str) -> float:
    """The number that a text states, of hertz where it names a unit; NaN for other text."""
    try:
        return float(text.casefold().removesuffix("hz"))
    except ValueError:
        return float("nan")


def _split_matrix(array: NamedArray, numbers: NDArray[np.float64]) -> list[_Column]:
    table = numbers if numbers.shape[0] >= numbers.shape[1] else numbers.T
    axis_rate = None
    if is_uniform_ramp(table[:, 0]):
        axis_rate, _ = rate_from_times(table[:, 0])
        table = table[:, 1:]
    count = table.shape[1]
    given = _texts(_lookup(array.attributes, _NAME_KEYS))
    if len(given) == count + 1 and axis_rate is not None:
        given = given[1:]
    if len(given) == count:
        names = given
    elif count == 1:
        names = (array.name,)
    else:
        names = tuple(f"{array.name}_{i + 1}" for i in range(count))
    units = _texts(_lookup(array.attributes, _UNIT_KEYS))
    units = units if len(units) == count else units * count if len(units) == 1 else ()
    return [
        _Column(
            path=(*array.path[:-1], name),
            samples=np.ascontiguousarray(table[:, i]),
            attributes={"unit": units[i]} if units else {},
            axis_rate=axis_rate,
            matrix=array.path,
        )
        for i, name in enumerate(names)
    ]


def _without_housekeeping(columns: list[_Column], notes: list[str]) -> list[_Column]:
    """Leave out the handful of numbers (channel numbers, sensitivities) that stand beside real records."""
    longest = max((c.samples.size for c in columns), default=0)
    enough = min(_FEWEST_SAMPLES, longest)
    for column in columns:
        if column.samples.size < enough:
            notes.append(f"'{'/'.join(column.path)}' has {column.samples.size} values and is left out")
    return [c for c in columns if c.samples.size >= enough]


def _one_axis(
    columns: list[_Column], stated: float | None, notes: list[str]
) -> tuple[list[_Column], float | None]:
    """Keep the columns on the time axis: files of analysers hold spectra on a frequency axis as well."""
    own = [c for c in columns if c.axis_rate is not None]
    if not own:
        return columns, None

    def misfit(column: _Column) -> float:
        return abs((column.axis_rate or 0.0) / stated - 1) if stated else -float(column.samples.size)

    chosen = min(own, key=misfit).axis_rate or 0.0
    kept = [c for c in columns if c.axis_rate is None or abs(c.axis_rate / chosen - 1) < 1e-3]
    for column in own:
        if abs((column.axis_rate or 0.0) / chosen - 1) >= 1e-3:
            notes.append(f"'{'/'.join(column.path)}' has another axis (a spectrum?) and is left out")
    return kept, chosen


def _shortest_unique(paths: list[tuple[str, ...]]) -> tuple[str, ...]:
    """Names without their groups where that is unambiguous."""
    counts = Counter(path[-1] for path in paths)
    return tuple(path[-1] if counts[path[-1]] == 1 else "/".join(path) for path in paths)


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.casefold())


def _lookup(attributes: Mapping[str, Any], keys: set[str]) -> Any:
    return next((v for name, v in attributes.items() if _key(name) in keys and np.size(v) > 0), None)


def _text(attributes: Mapping[str, Any], keys: set[str]) -> str | None:
    """The one text under any of the keys."""
    found = _texts(_lookup(attributes, keys))
    return found[0] if len(found) == 1 else None


def _texts(values: Any) -> tuple[str, ...]:
    """Texts of an array, a list or one text; none of None."""
    if values is None:
        return ()

    def text(item: Any) -> str:
        while isinstance(item, np.ndarray) and item.size == 1:
            item = item.ravel()[0]
        return item.decode("utf-8", errors="replace") if isinstance(item, bytes) else str(item).strip()

    return tuple(text(item) for item in np.ravel(np.asarray(values)))
