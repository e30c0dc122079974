"""Modes, shapes and FRFs as tables and CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ema_pipeline.correlate.types import Pairing, percent_off
from ema_pipeline.files import replace_file, replacing
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel

Row = dict[str, str | int | float | None]

MODES_COLUMNS = (
    "configuration",
    "mode",
    "frequency_hz",
    "frequency_std_hz",
    "damping_ratio",
    "damping_std",
    "mpc",
    "stability",
    "method",
    "model_mode",
    "model_frequency_hz",
    "difference_percent",
    "mac",
    "family",
    "flags",
)
"""Columns of modes.csv."""


def modes_table(modal: ModalModel, configuration: str = "", pairing: Pairing | None = None) -> list[Row]:
    """One row per mode, with the columns of `MODES_COLUMNS`; flags are joined by ``"; "``.

    Modes are numbered from 1; what is said of the model is None where `pairing` has no partner.
    """
    pairs = {} if pairing is None else {p.measured: p for p in pairing.pairs}
    return [
        {
            "configuration": configuration,
            "mode": index + 1,
            "frequency_hz": mode.frequency_hz,
            "frequency_std_hz": mode.frequency_std_hz,
            "damping_ratio": mode.damping_ratio,
            "damping_std": mode.damping_std,
            "mpc": mode.mpc,
            "stability": mode.stability,
            "method": mode.method,
            "model_mode": pairs[index].model + 1 if index in pairs else None,
            "model_frequency_hz": pairs[index].model_frequency_hz if index in pairs else None,
            "difference_percent": (
                percent_off(mode.frequency_hz, pairs[index].model_frequency_hz) if index in pairs else None
            ),
            "mac": pairs[index].mac if index in pairs else None,
            "family": pairs[index].family if index in pairs else None,
            "flags": "; ".join(mode.flags),
        }
        for index, mode in enumerate(modal.modes)
    ]


def shapes_table(modal: ModalModel, configuration: str = "") -> list[Row]:
    """One row per mode: its entry at every DOF as real and imaginary part, ``"sun.x re"``, ``"sun.x im"``."""
    rows: list[Row] = []
    for index, mode in enumerate(modal.modes):
        row: Row = {"configuration": configuration, "mode": index + 1, "frequency_hz": mode.frequency_hz}
        for dof, value in zip(modal.dofs, mode.shape, strict=True):
            row[f"{dof.point} re"] = float(value.real)
            row[f"{dof.point} im"] = float(value.imag)
        rows.append(row)
    return rows


def write_table(path: Path | str, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows as CSV, as `csv_text`.

    Raises
    ------
    EmaError
        If the file cannot be written.
    """
    replace_file(Path(path), csv_text(rows))


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows as CSV; a column that only some rows have is empty in the others, and so are None and NaN.

    Without rows, the header of the table of modes.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row)) or list(MODES_COLUMNS)
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: "" if v != v else v for k, v in row.items()} for row in rows)
    return text.getvalue()


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
    with replacing(Path(path)) as scratch:
        np.savetxt(
            scratch,
            np.stack(columns, axis=1),
            fmt="%.12g",
            delimiter=",",
            header=",".join(names),
            comments="",
            encoding="utf-8",
        )
