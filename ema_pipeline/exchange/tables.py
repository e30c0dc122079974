"""Modes, shapes and FRFs as tables and CSV files."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel

Row = dict[str, str | int | float]

MODES_COLUMNS = (
    "configuration",
    "index",
    "frequency_hz",
    "frequency_std_hz",
    "damping_ratio",
    "damping_std",
    "mpc",
    "stability",
    "method",
    "flags",
)
"""Columns of modes.csv."""


def modes_table(modal: ModalModel, configuration: str = "") -> list[Row]:
    """One row per mode, with the columns of `MODES_COLUMNS`; flags are joined by ``"; "``."""
    return [
        {
            "configuration": configuration,
            "index": index,
            "frequency_hz": mode.frequency_hz,
            "frequency_std_hz": mode.frequency_std_hz,
            "damping_ratio": mode.damping_ratio,
            "damping_std": mode.damping_std,
            "mpc": mode.mpc,
            "stability": mode.stability,
            "method": mode.method,
            "flags": "; ".join(mode.flags),
        }
        for index, mode in enumerate(modal.modes)
    ]


def shapes_table(modal: ModalModel, configuration: str = "") -> list[Row]:
    """One row per mode: its entry at every DOF as real and imaginary part, ``"sun.x re"``, ``"sun.x im"``."""
    rows: list[Row] = []
    for index, mode in enumerate(modal.modes):
        row: Row = {"configuration": configuration, "index": index, "frequency_hz": mode.frequency_hz}
        for dof, value in zip(modal.dofs, mode.shape, strict=True):
            row[f"{dof.point} re"] = float(value.real)
            row[f"{dof.point} im"] = float(value.imag)
        rows.append(row)
    return rows


def write_table(path: Path | str, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows as CSV; a column that only some rows have is empty in the others, and so is NaN.

    Raises
    ------
    EmaError
        If the file cannot be written.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row)) or list(MODES_COLUMNS)
    try:
        with Path(path).open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows({k: "" if v != v else v for k, v in row.items()} for row in rows)
    except OSError as error:
        raise _unwritable(path, error) from None


def write_frf_csv(path: Path | str, frfs: FrfSet) -> None:
    """Write all measured FRFs: a column of frequency, then real part, imaginary part, coherence of each.

    Column names read ``"sun.x/sun.y re (m/s^2/N)"``; a coherence that is not known has no column.

    Raises
    ------
    EmaError
        If the file cannot be written.
    """
    unit = {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m"}
    per = "N" if frfs.force_calibrated else "V"
    names, columns = ["frequency_hz"], [frfs.frequency_hz]
    for o, i in zip(*np.nonzero(frfs.hits > 0), strict=True):
        pair = f"{frfs.outputs[o].point}/{frfs.inputs[i].point}"
        names += [f"{pair} {part} ({unit[frfs.quantities[o]]}/{per})" for part in ("re", "im")]
        columns += [frfs.frf[o, i].real, frfs.frf[o, i].imag]
        if np.any(np.isfinite(frfs.coherence[o, i])):
            names.append(f"{pair} coherence")
            columns.append(frfs.coherence[o, i])
    try:
        np.savetxt(
            path,
            np.stack(columns, axis=1),
            fmt="%.12g",
            delimiter=",",
            header=",".join(names),
            comments="",
            encoding="utf-8",
        )
    except OSError as error:
        raise _unwritable(path, error) from None


def _unwritable(path: Path | str, error: OSError) -> EmaError:
    return EmaError(f"{path}: cannot be written ({error.strerror}); check folder and permissions")
