"""Measured modes from a table, TOML or CSV, in place of raw data.

TOML: one table per configuration of the rig::

    schema = 1

    [default]
    frequency_hz = [0.88, 2.75]
    frequency_std_hz = 0.002            # one for all, or one per mode; may be left out
    damping_ratio = [0.011, 0.004]      # may be left out, as damping_std
    dofs = ["storey1.x", "storey2.x"]   # may be left out, with shape
    shape = [[0.38, 1.00],              # rows: dofs; columns: modes
             [0.72, 0.72]]
    shape_imag = [[0.0, 0.0], [0.0, 0.0]]   # for complex shapes
    shape_std = 0.02                    # one for all, relative to a mode's largest entry
    scaled = false                      # true where shapes are mass-normalised
    band_hz = [0.1, 10.0]               # where modes were looked for
    references = ["storey2.x"]          # points that were struck

CSV: one row per mode with ``frequency_hz`` and as many of ``configuration``, ``frequency_std_hz``,
``damping_ratio``, ``damping_std`` as are known; shapes in columns named by their DOF, ``sun.x``, or
``sun.x re`` and ``sun.x im``. The files that `ema` itself writes are read back.
"""

from __future__ import annotations

import csv
import re
import tomllib
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.rigs.types import Rig
from ema_pipeline.settings import Settings, parse

_NUMBERS = ("frequency_hz", "frequency_std_hz", "damping_ratio", "damping_std")
_PASSED_OVER = (
    "mode", "index", "mpc", "stability", "method", "flags", "model_mode", "model_frequency_hz", "difference_percent",
    "mac", "family",
)  # fmt: skip
FEWEST_ROUNDED = 3
"""Fewer numbers may all end on 0 by chance, and look more rounded than they are."""
_SHAPE = re.compile(r"^(?P<dof>-?[\w-]+\.\w+)(?: (?P<part>re|im))?$")


class ConfigurationModes(Settings):
    """The modes of one configuration in a TOML table of modes."""

    frequency_hz: tuple[float, ...] = Field(min_length=1, description="natural frequencies, Hz")
    frequency_std_hz: float | tuple[float, ...] | None = Field(None, description="standard deviations, Hz")
    damping_ratio: tuple[float, ...] | None = Field(None, description="damping ratios")
    damping_std: float | tuple[float, ...] | None = Field(None, description="their standard deviations")
    dofs: tuple[str, ...] = Field((), description="places of the shapes' entries")
    shape: tuple[tuple[float, ...], ...] = Field((), description="rows: dofs; columns: modes")
    shape_imag: tuple[tuple[float, ...], ...] = Field((), description="imaginary part, like shape")
    shape_std: float | None = Field(
        None, gt=0, description="standard deviation of entries, relative to a mode's largest"
    )
    scaled: bool = Field(False, description="true where shapes are mass-normalised")
    band_hz: tuple[float, float] | None = Field(None, description="band in which modes were looked for")
    references: tuple[str, ...] = Field((), description="points that were struck")


def read_mode_table(path: Path | str, rig: Rig | None = None) -> dict[str, MeasuredModes]:
    """Read a table of modes.

    Parameters
    ----------
    path : Path
        A TOML or CSV file as described at the head of this module.
    rig : Rig, optional
        Configurations and DOFs are checked against it; a table without a configuration takes its only one.

    Returns
    -------
    dict of str to MeasuredModes
        By configuration.

    Raises
    ------
    EmaError
        Names file, configuration and key of whatever is wrong.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise EmaError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise EmaError(f"{path}: is not UTF-8 text; save it as UTF-8") from None
    tables = _from_toml(text, path) if path.suffix.lower() == ".toml" else _from_csv(text, path, rig)
    return {name: _measured(name, table, path, rig) for name, table in tables.items()}


def _from_toml(text: str, path: Path) -> dict[str, ConfigurationModes]:
    try:
        data: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise EmaError(f"{path}: not valid TOML: {error}") from None
    version = data.pop("schema", 1)
    if version != 1:
        raise EmaError(f"{path}: schema = {version} is unknown; this program reads schema = 1")
    data.pop("title", None)
    for name, table in data.items():
        if not isinstance(table, dict):
            raise EmaError(
                f"{path}: key '{name}' is not in a table; put the modes under the name of their "
                "configuration, e.g. [default]"
            )
    if not data:
        raise EmaError(f"{path}: holds no modes; add a table such as [default] with frequency_hz = [...]")
    return {name: parse(ConfigurationModes, table, f"{path} [{name}]") for name, table in data.items()}


def _from_csv(text: str, path: Path, rig: Rig | None) -> dict[str, ConfigurationModes]:
    lines = text.splitlines()
    delimiter = ";" if lines and lines[0].count(";") > lines[0].count(",") else ","
    reader = csv.DictReader(lines, delimiter=delimiter, skipinitialspace=True)
    columns = [c.strip() for c in reader.fieldnames or ()]
    reader.fieldnames = columns
    if "frequency_hz" not in columns:
        raise EmaError(f"{path}: has no column 'frequency_hz'{did_you_mean('frequency_hz', columns)}")
    shapes = {c: m for c in columns if (m := _SHAPE.match(c))}
    read = [f"{shapes[c]['dof']} {shapes[c]['part'] or 're'}" if c in shapes else c for c in columns]
    twice = next((c for c, what in zip(columns, read, strict=True) if read.count(what) > 1), None)
    if twice is not None:
        raise EmaError(f"{path}: line 1: column '{twice}' is there twice; keep one of the two")
    for column in columns:
        if column not in ("configuration", *_NUMBERS, *_PASSED_OVER) and column not in shapes:
            hint = did_you_mean(column, ("configuration", *_NUMBERS))
            raise EmaError(f"{path}: column '{column}' is neither known nor a dof such as 'sun.x'{hint}")
    groups: dict[str, list[tuple[int, dict[str, str]]]] = {}
    only = rig.configurations[0] if rig is not None and len(rig.configurations) == 1 else "default"
    for row in reader:
        if any((v or "").strip() for v in row.values() if isinstance(v, str)):
            groups.setdefault((row.get("configuration") or "").strip() or only, []).append(
                (reader.line_num, row)
            )
    if not groups:
        raise EmaError(f"{path}: holds no modes; add one row per mode")
    return {name: _table(rows, columns, shapes, f"{path} [{name}]", path) for name, rows in groups.items()}


def _table(
    rows: Sequence[tuple[int, dict[str, str]]],
    columns: Sequence[str],
    shapes: Mapping[str, re.Match[str]],
    where: str,
    path: Path,
) -> ConfigurationModes:
    def numbers(column: str) -> list[float]:
        found = []
        for line, row in rows:
            value = (row[column] or "").strip()
            try:
                found.append(float(value) if value else np.nan)
            except ValueError:
                remedy = "; write decimals with a point" if "," in value else ""
                raise EmaError(f"{path}: line {line}: {column} = '{value}' is no number{remedy}") from None
        return found

    data: dict[str, Any] = {}
    for name in _NUMBERS:
        if name in columns:
            values = numbers(name)
            if not np.all(np.isnan(values)):
                if np.any(np.isnan(values)):
                    line = rows[int(np.flatnonzero(np.isnan(values))[0])][0]
                    raise EmaError(f"{path}: line {line}: {name} is missing; fill it in or drop the column")
                data[name] = values
    dofs = list(dict.fromkeys(m["dof"] for m in shapes.values()))
    if dofs:
        parts = {"re": np.zeros((len(dofs), len(rows))), "im": np.zeros((len(dofs), len(rows)))}
        for column, match in shapes.items():
            parts[match["part"] or "re"][dofs.index(match["dof"])] = numbers(column)
        if np.any(np.isnan(parts["re"])) or np.any(np.isnan(parts["im"])):
            raise EmaError(f"{where}: a shape has empty cells; give every mode an entry at every dof")
        data |= {"dofs": dofs, "shape": parts["re"].tolist()}
        if np.any(parts["im"]):
            data["shape_imag"] = parts["im"].tolist()
    return parse(ConfigurationModes, data, where)


def _measured(name: str, table: ConfigurationModes, path: Path, rig: Rig | None) -> MeasuredModes:
    where = f"{path} [{name}]"
    if rig is not None and name not in rig.configurations:
        hint = did_you_mean(name, rig.configurations)
        raise EmaError(f"{path}: rig '{rig.name}' has no configuration '{name}'{hint}")
    frequency = np.array(table.frequency_hz, dtype=float)
    count = len(frequency)
    if not np.all(frequency > 0):
        raise EmaError(f"{where}: frequency_hz = {frequency.min():g}: measured frequencies are above 0 Hz")
    damping = _column(table.damping_ratio, count, "damping_ratio", where)
    if np.any(damping < 0):
        raise EmaError(f"{where}: damping_ratio = {np.nanmin(damping):g} is negative; correct it")
    if np.any(damping >= 1):
        raise EmaError(
            f"{where}: damping_ratio = {np.nanmax(damping):g}: a mode's ratio is below 1; 1 % is written 0.01"
        )
    if table.band_hz is not None and not 0 <= table.band_hz[0] < table.band_hz[1]:
        low, high = table.band_hz
        raise EmaError(f"{where}: band_hz = [{low:g}, {high:g}]: give the lower limit first")
    dofs, references = _places(table.dofs, name, where, rig), _places(table.references, name, where, rig)
    shapes = _shapes(table, count, where)
    order = np.argsort(frequency, kind="stable")
    shape_std = None
    if shapes is not None:
        # A sensor or row that points the other way.
        shapes = (shapes * np.array([d.sign for d in dofs]))[order]
        dofs = tuple(Dof(d.body, d.direction) for d in dofs)
        if table.shape_std is not None:
            largest = np.max(np.abs(shapes), axis=1, keepdims=True)
            shape_std = table.shape_std * np.broadcast_to(largest, shapes.shape)
    notes = []
    spreads = {}
    for key, values, stated, unit in (
        ("frequency_std_hz", table.frequency_hz, table.frequency_std_hz, " Hz"),
        ("damping_std", table.damping_ratio or (), table.damping_std, ""),
    ):
        spread, rounding = _spread(stated, count, key, where), _rounding(values)
        if np.any(spread < rounding):
            notes.append(
                f"{key} = {np.nanmin(spread):.2g}{unit} is finer than the rounding of the table's numbers: "
                f"{rounding:.2g}{unit} is taken"
            )
        spreads[key] = np.maximum(spread, rounding)  # unknown ones, NaN, stay unknown
    return MeasuredModes(
        configuration=name,
        frequency_hz=frequency[order],
        frequency_std_hz=spreads["frequency_std_hz"][order],
        damping_ratio=damping[order],
        damping_std=spreads["damping_std"][order],
        shapes=shapes,
        shape_std=shape_std,
        dofs=dofs,
        scaled=table.scaled,
        band_hz=table.band_hz,
        references=references,
        notes=tuple(notes),
    )


def _rounding(values: Sequence[float]) -> float:
    """Standard deviation that rounding to the decimals of these numbers brings; 0 for too few to tell by."""
    if len(values) < FEWEST_ROUNDED:
        return 0.0
    exponents = [Decimal(repr(v)).normalize().as_tuple().exponent for v in values]
    last = min(e for e in exponents if isinstance(e, int))
    return float(10.0 ** min(last, 0) / np.sqrt(12))


def _places(texts: Sequence[str], configuration: str, where: str, rig: Rig | None) -> tuple[Dof, ...]:
    try:
        dofs = tuple(Dof.parse(text) for text in texts)
        for dof in dofs:
            if rig is not None and not rig.knows(configuration, dof):
                rig.assembly(configuration).row(dof.point)  # raises with a hint
    except EmaError as error:
        raise EmaError(f"{where}: {error}") from None
    if len({dof.point for dof in dofs}) != len(dofs):
        raise EmaError(f"{where}: a place is named twice among {', '.join(texts)}; name each once")
    return dofs


def _column(
    given: float | tuple[float, ...] | None, count: int, name: str, where: str
) -> NDArray[np.float64]:
    """One number per mode, (n_modes,); NaN where not given."""
    if given is None:
        return np.full(count, np.nan)
    if isinstance(given, float | int):
        return np.full(count, float(given))
    if len(given) != count:
        raise EmaError(f"{where}: {name} has {len(given)} numbers for {count} frequencies; give one per mode")
    return np.array(given, dtype=float)


def _spread(
    given: float | tuple[float, ...] | None, count: int, name: str, where: str
) -> NDArray[np.float64]:
    """One standard deviation per mode, (n_modes,); NaN where not given."""
    values = _column(given, count, name, where)
    if np.any(values <= 0):
        raise EmaError(
            f"{where}: {name} = {np.nanmin(values):g}: a standard deviation is above 0; leave out what is unknown"
        )
    return values


def _shapes(table: ConfigurationModes, count: int, where: str) -> NDArray[np.complex128] | None:
    """Shapes as (n_modes, n_dofs), or None."""
    if not table.dofs and not table.shape:
        return None
    result = np.zeros((len(table.dofs), count), dtype=complex)
    for key, rows, factor in (("shape", table.shape, 1.0), ("shape_imag", table.shape_imag, 1j)):
        if not rows and key == "shape_imag":
            continue
        lengths = {len(r) for r in rows}
        if len(rows) != len(table.dofs) or lengths != {count}:
            found = f"{len(rows)} rows of {', '.join(map(str, sorted(lengths))) or 'no'} numbers"
            raise EmaError(
                f"{where}: {key} has {found}; it needs one row for each of {len(table.dofs)} dofs with "
                f"one number for each of {count} modes"
            )
        result += factor * np.array(rows)
    if not np.all(np.any(result != 0, axis=0)):
        raise EmaError(f"{where}: shape of a mode is all zero; correct it or leave the mode out")
    return np.asarray(result.T)
