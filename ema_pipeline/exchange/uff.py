"""Universal file (ASCII): FRFs as dataset 58, shapes as 55, geometry as 15 and 82, units as 164.

References
----------
SDRC I-DEAS universal file format, datasets 15, 55, 58, 82 and 164, as kept by the University of Cincinnati
Structural Dynamics Research Laboratory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.exchange.geometry import Geometry
from ema_pipeline.exchange.nodes import NodeTable, node_table
from ema_pipeline.files import replacing
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.assurance import real_shape
from ema_pipeline.modal.types import ModalModel, Mode

_FRF, _COHERENCE = 4, 6  # function types of dataset 58
_REAL_DOUBLE, _COMPLEX_DOUBLE = 4, 6  # ordinate data types
_FREQUENCY, _EXCITATION_FORCE, _UNKNOWN = 18, 13, 0  # specific data types
_NUMERATOR = {"acceleration": 12, "velocity": 11, "displacement": 8}
_UNIT = {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m"}
REAL_SHAPES, COMPLEX_SHAPES = 1, 2
"""Load case numbers under which dataset 55 has every mode as a normal and as a complex mode."""


def write_uff(
    path: Path | str, frfs: FrfSet | None, modal: ModalModel | None, geometry: Geometry | None = None
) -> NodeTable:
    """Write FRFs, coherences, shapes and geometry to one universal file.

    Parameters
    ----------
    path : Path or str
    frfs : FrfSet or None
        Each measured FRF as function type 4, its coherence (where known) as type 6.
    modal : ModalModel or None
        Each mode twice in dataset 55: under load case 1 as a normal mode (turned to be as real as possible;
        frequency, modal mass 1 or 0 for unscaled shapes, damping ratio), under load case 2 as a complex mode
        (eigenvalue, modal A and B). DOFs without measurement are 0 or left out.
    geometry : Geometry, optional

    Returns
    -------
    NodeTable
        Numbers given to the DOFs; ID line 2 of each dataset 58 names the DOFs in words too.

    Raises
    ------
    EmaError
        If the file cannot be written.
    """
    dofs: list[Dof] = []
    if frfs is not None:
        dofs += [*frfs.outputs, *frfs.inputs]
    if modal is not None:
        dofs += modal.dofs
    if geometry is not None:
        dofs += [Dof(body, "x") for body in geometry.positions_m]
    table = node_table(dofs)
    with (
        replacing(Path(path)) as scratch,
        scratch.open("w", encoding="ascii", errors="replace", newline="\n") as file,
    ):
        for line in _lines(frfs, modal, geometry, table):
            file.write(line + "\n")
    return table


def _lines(
    frfs: FrfSet | None, modal: ModalModel | None, geometry: Geometry | None, table: NodeTable
) -> Iterator[str]:
    yield from _dataset(164, _units())
    if geometry is not None:
        yield from _dataset(15, _coordinates(geometry, table))
        for number, path in enumerate(geometry.lines, start=1):
            yield from _dataset(82, _trace(number, path, table))
    if frfs is not None:
        for o, i in zip(*np.nonzero(frfs.hits > 0), strict=True):
            if not np.all(np.isfinite(frfs.frf[o, i, 1:])):
                continue
            yield from _dataset(58, _function(frfs, int(o), int(i), frfs.frf[o, i], table))
            if np.all(np.isfinite(frfs.coherence[o, i, 1:])):
                yield from _dataset(58, _function(frfs, int(o), int(i), frfs.coherence[o, i], table))
    if modal is not None:
        for number, mode in enumerate(modal.modes, start=1):
            yield from _dataset(55, _normal_mode(modal, mode, number, table))
            yield from _dataset(55, _complex_mode(modal, mode, number, table))


def _dataset(number: int, body: Iterable[str]) -> Iterator[str]:
    yield f"{-1:6d}"
    yield f"{number:6d}".ljust(80)
    yield from body
    yield f"{-1:6d}"


def _units() -> Iterator[str]:
    yield f"{1:10d}{'SI: Meter (newton)':<20}{2:10d}"
    yield "".join(f"{1.0:25.17e}" for _ in range(3)).replace("e", "D")
    yield f"{273.15:25.17e}".replace("e", "D")


def _coordinates(geometry: Geometry, table: NodeTable) -> Iterator[str]:
    for name, node in table.nodes.items():
        position = geometry.positions_m.get(table.body[name])
        if position is not None:
            # five decimals keep a blank before a minus: some readers of this dataset split at blanks
            yield f"{node:10d}{0:10d}{0:10d}{0:10d}" + "".join(f"{v:13.5e}" for v in position)


def _trace(number: int, path: tuple[str, ...], table: NodeTable) -> Iterator[str]:
    missing = [body for body in path if body not in table.nodes]
    if missing:
        raise EmaError(f"geometry: line {number} names '{missing[0]}', which has no position; add it")
    nodes = [table.nodes[body] for body in path]
    yield f"{number:10d}{len(nodes):10d}{0:10d}"
    yield _text(" - ".join(path))
    for start in range(0, len(nodes), 8):
        yield "".join(f"{node:10d}" for node in nodes[start : start + 8])


def _function(
    frfs: FrfSet, o: int, i: int, values: NDArray[np.complex128] | NDArray[np.float64], table: NodeTable
) -> Iterator[str]:
    """Records 1 to 12 of dataset 58; complex values are an FRF, real ones a coherence."""
    output, input_ = frfs.outputs[o], frfs.inputs[i]
    is_frf = np.iscomplexobj(values)
    quantity = frfs.quantities[o]
    name = f"{frfs.estimator} FRF" if is_frf else "Coherence"
    yield _text(f"{name} {output.point} / {input_.point}")
    yield _text(f"response {output.point}, reference {input_.point}")
    yield _text("")
    yield _text(f"{int(frfs.hits[o, i])} hits averaged")
    if frfs.response_decay_rad_s:
        yield _text(f"exponential window, decay {frfs.response_decay_rad_s:.9g} rad/s, still in the data")
    else:
        yield _text("")
    response, reference = table.dofs[output.point], table.dofs[input_.point]
    kind = _FRF if is_frf else _COHERENCE
    yield (
        f"{kind:5d}{1:10d}{0:5d}{0:10d}"
        f" {_short(output.body):<10}{response[0]:10d}{response[1]:4d}"
        f" {_short(input_.body):<10}{reference[0]:10d}{reference[1]:4d}"
    )
    step = float(frfs.frequency_hz[-1] - frfs.frequency_hz[0]) / max(frfs.frequency_hz.size - 1, 1)
    form = _COMPLEX_DOUBLE if is_frf else _REAL_DOUBLE
    yield f"{form:10d}{values.size:10d}{1:10d}{_e13(float(frfs.frequency_hz[0]))}{_e13(step)}{_e13(0.0)}"
    force = _EXCITATION_FORCE if frfs.force_calibrated else _UNKNOWN
    yield _axis(_FREQUENCY, "Frequency", "Hz")
    if is_frf:
        yield _axis(_NUMERATOR[quantity], quantity.capitalize(), _UNIT[quantity])
        yield _axis(force, "Excitation force", "N" if frfs.force_calibrated else "V")
    else:
        yield _axis(_UNKNOWN, "Coherence", "NONE")
        yield _axis(_UNKNOWN, "NONE", "NONE")
    yield _axis(_UNKNOWN, "NONE", "NONE")
    finite = np.where(np.isfinite(values), values, 0.0)  # 0 Hz carries no information
    numbers = np.stack([finite.real, finite.imag], axis=-1).ravel() if is_frf else finite
    texts = [_e20(v) for v in numbers.tolist()]
    for start in range(0, len(texts), 4):
        yield "".join(texts[start : start + 4])


def _axis(kind: int, label: str, unit: str) -> str:
    return f"{kind:10d}{0:5d}{0:5d}{0:5d} {label:<20.20} {unit:<20.20}"


def _normal_mode(modal: ModalModel, mode: Mode, number: int, table: NodeTable) -> Iterator[str]:
    yield from _mode_head(modal, mode, number)
    # structural, normal mode, 3-DOF translation, displacement, real, values per node
    yield _integers(1, 2, 2, 8, 2, 3)
    yield _integers(2, 4, REAL_SHAPES, number)
    yield _reals(mode.frequency_hz, 1.0 if modal.scaled else 0.0, mode.damping_ratio, 0.0)
    shape, _ = real_shape(mode.shape)
    for node, values in _at_nodes(modal, shape, table):
        yield f"{node:10d}"
        yield _reals(*values.real)


def _complex_mode(modal: ModalModel, mode: Mode, number: int, table: NodeTable) -> Iterator[str]:
    yield from _mode_head(modal, mode, number)
    yield _integers(1, 3, 2, 8, 5, 3)  # as above, but complex eigenvalue and complex values
    yield _integers(2, 6, COMPLEX_SHAPES, number)
    # residue = φφᵀ/(modal A)
    modal_a = 2j * mode.pole.imag if modal.scaled else 0j
    modal_b = -mode.pole * modal_a
    yield _reals(mode.pole.real, mode.pole.imag, modal_a.real, modal_a.imag, modal_b.real, modal_b.imag)
    for node, values in _at_nodes(modal, mode.shape, table):
        yield f"{node:10d}"
        yield _reals(*np.stack([values.real, values.imag], axis=1).ravel())


def _mode_head(modal: ModalModel, mode: Mode, number: int) -> Iterator[str]:
    yield _text(f"Mode {number}, {mode.method}")
    scaling = "mass-normalised" if modal.scaled else f"unscaled: {modal.scaling_note}"
    yield _text(f"shapes {scaling}")
    yield _text("")
    yield _text("")
    yield _text(f"Mode same{number:10d} Frequency{mode.frequency_hz:13.5e}")


def _at_nodes(
    modal: ModalModel, shape: NDArray[np.complex128], table: NodeTable
) -> Iterator[tuple[int, NDArray[np.complex128]]]:
    """Nodes with at least one measured direction, and their three displacements."""
    nodes: dict[int, NDArray[np.complex128]] = {}
    for dof, value in zip(modal.dofs, shape, strict=True):
        node, direction = table.dofs[dof.point]
        if np.isfinite(value) and direction <= 3:
            nodes.setdefault(node, np.zeros(3, dtype=np.complex128))[direction - 1] = value
    yield from sorted(nodes.items())


def _integers(*values: int) -> str:
    return "".join(f"{v:10d}" for v in values)


def _reals(*values: float) -> str:
    """Format 6E13.5."""
    texts = [_e13(float(v)) for v in values]
    return "".join(texts)


def _e13(value: float) -> str:
    """13 columns with all the digits that they hold: six decimals where the format asks for five."""
    if abs(value) < 1e-99:
        return f"{0.0:13.6e}"
    text = f"{value:13.6e}"
    return text if len(text) <= 13 else f"{value:13.5e}"


def _e20(value: float) -> str:
    """20 columns, twelve decimals; what is smaller than the exponent can tell is 0."""
    return f"{0.0 if abs(value) < 1e-99 else value:20.12e}"


def _text(line: str) -> str:
    """An ID line: 80 columns, never blank."""
    return f"{line or 'NONE':<80.80}"


def _short(name: str) -> str:
    return name[:10]
