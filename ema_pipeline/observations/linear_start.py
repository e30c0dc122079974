"""Where a fit of records begins: values of a rig's masses, springs and dampers that its measured FRFs suggest.

Records in time can only be fitted from nearby. Logarithms of FRFs can be fitted from far off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.mechanics.modes import total_damping
from ema_pipeline.mechanics.system import LinearSystem, sensor_row
from ema_pipeline.observations.rig_model import RigModel

_LINES = 120
"""Lines of the FRFs that are compared."""
_LEAST_STD = 0.05
"""1 σ of ln |H| that no FRF falls below: the response to a strong force is that of the best linear model only."""
_POWER = {"displacement": 0, "velocity": 1, "acceleration": 2}
_DAMPING = 0.02
"""Damping ratio from which the search begins."""
_ROOM, _DAMPING_ROOM = 9.0, 2.5
"""Largest change of a logarithm: four decades; of the common damping ratio to 0.16 % or 24 %, so that a broad peak
that is bent by a nonlinearity is not taken for an overdamped mode."""
_FAR = 60.0
"""Sum of squares of a pair of FRFs with nothing in common."""


@dataclass(frozen=True)
class MeasuredFrfs:
    """Pairs of FRFs at a choice of lines.

    Attributes
    ----------
    omega : ndarray, (n_lines,)
    log : complex ndarray, (n_pairs, n_lines)
        Natural logarithm of the receptance; its imaginary part is the phase.
    weight : ndarray, (n_pairs, n_lines)
        1/σ of it.
    pairs : tuple of (int, int)
        Output and input.
    """

    omega: NDArray[np.float64]
    log: NDArray[np.complex128]
    weight: NDArray[np.float64]
    pairs: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, frfs: FrfSet) -> MeasuredFrfs:
        """FRFs in their band, densest where they are largest."""
        low, high = np.searchsorted(frfs.frequency_hz, frfs.band_hz)
        at = np.arange(max(int(low), 1), max(int(high), int(low) + 2))
        omega = 2 * np.pi * frfs.frequency_hz
        chosen = np.unique(np.linspace(at[0], at[-1], min(_LINES, len(at))).astype(int))
        logs, weights, pairs = [], [], []
        for o, i in np.argwhere(frfs.hits > 0):
            h = frfs.frf[o, i, chosen] / (1j * omega[chosen]) ** _POWER[frfs.quantities[o]]
            size = np.abs(h)
            noise = np.nan_to_num(frfs.variance[o, i, chosen]) / np.maximum(
                np.abs(frfs.frf[o, i, chosen]) ** 2, 1e-300
            )
            good = size > 0
            logs.append(np.log(np.where(good, h, 1.0)))
            weights.append(np.where(good, 1 / np.sqrt(_LEAST_STD**2 + noise), 0.0))
            pairs.append((int(o), int(i)))
        return cls(omega[chosen], np.array(logs), np.array(weights), tuple(pairs))

    @property
    def peak(self) -> float:
        """Angular frequency of the largest response, in velocity, rad/s."""
        level = np.sum(np.where(self.weight > 0, np.exp(2 * self.log.real), 0.0), axis=0) * self.omega**2
        return float(self.omega[int(np.argmax(level))])

    def difference(self, system: LinearSystem, frfs: FrfSet) -> NDArray[np.float64]:
        """Weighted differences of the model's logarithms from the measured ones, (2·n_pairs·n_lines,)."""
        damping = total_damping(system)
        dynamic = (
            system.stiffness
            + 1j * self.omega[:, None, None] * damping
            - self.omega[:, None, None] ** 2 * system.mass
        )
        drive = np.stack([sensor_row(system, d) for d in frfs.inputs])
        read = np.stack([sensor_row(system, d) for d in frfs.outputs])
        solved = np.linalg.solve(dynamic, np.broadcast_to(drive.T, (len(self.omega), *drive.T.shape)))
        h = np.einsum("on,wni->oiw", read, solved)
        model = np.array([h[o, i] for o, i in self.pairs])
        gap = np.log(np.where(model == 0, 1e-300, model)) - self.log
        phase = np.angle(np.exp(1j * gap.imag))
        return np.concatenate([(gap.real * self.weight).ravel(), (phase * self.weight).ravel()])


def linear_start(
    model: RigModel, configuration: str, loose: list[str], damping: str, frfs: FrfSet
) -> dict[str, float]:
    """Values of loose unknowns at which the rig's FRFs are nearest to the measured ones.

    Parameters
    ----------
    model : RigModel
        Without effects.
    configuration : str
    loose : list of str
        Unknowns that the records determine: logarithms of masses, springs, dampers.
    damping : str
        Name of the common damping ratio among the unknowns; empty where there is none.
    frfs : FrfSet

    Returns
    -------
    dict of str to float
        By the names in `loose`, and `damping`.
    """
    measured = MeasuredFrfs.of(frfs)
    index = model.unknowns.index
    names = [*loose, *([damping] if damping else [])]
    if not names or not len(measured.pairs):
        return {}
    at = [index[n] for n in names]

    def residual(values: NDArray[np.float64]) -> NDArray[np.float64]:
        x = np.zeros(len(model.unknowns))
        x[at] = values
        with np.errstate(all="ignore"):
            try:
                found = measured.difference(model.system(configuration, x), frfs)
            except np.linalg.LinAlgError:
                return np.full(2 * measured.log.size, _FAR)
        return np.nan_to_num(found, nan=_FAR, posinf=_FAR, neginf=-_FAR)

    room = np.full(len(names), _ROOM)
    room[len(loose) :] = _DAMPING_ROOM
    best: scipy.optimize.OptimizeResult | None = None
    for start in _starts(model, configuration, names, damping, measured, residual):
        found = scipy.optimize.least_squares(
            residual, start, method="trf", loss="soft_l1", bounds=(start - room, start + room), max_nfev=60
        )
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    return dict(zip(names, (float(v) for v in best.x), strict=True))


def _starts(
    model: RigModel,
    configuration: str,
    names: Sequence[str],
    damping: str,
    measured: MeasuredFrfs,
    residual: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> Iterator[NDArray[np.float64]]:
    """Starts: the rig's own values, and those that put a mode at the measured peak; sizes agree on average."""
    plain = model.system(configuration, np.zeros(len(model.unknowns)))
    values = scipy.linalg.eigh(plain.stiffness, plain.mass, eigvals_only=True)
    powers = np.array([_STIFFENED[_kind(model, configuration, n)] for n in names])
    sized = np.arange(len(names)) < len(names) - bool(damping)
    peaks = measured.peak / np.sqrt(values[values > 1e-9 * np.max(values)])
    for factor in (1.0, *peaks.tolist()):
        start = powers * 2 * np.log(factor)
        if damping:
            start[-1] = np.log(_DAMPING / model.rig.parameters[damping].value)
        seen = measured.weight.ravel() > 0
        gap = residual(start)[: measured.log.size][seen] / measured.weight.ravel()[seen]
        yield start + float(np.median(gap)) * sized


_STIFFENED = {"Mass": 0.0, "Damper": 0.5, "Spring": 1.0}
"""Powers with which values follow the stiffness where frequencies move and shapes and damping ratios stay."""


def _kind(model: RigModel, configuration: str, name: str) -> str:
    """Kind of the elements that an unknown scales."""
    i = model.unknowns.index[name]
    rows = model.dependence.elements[configuration]
    kinds = [key[0].__name__ for key, row in rows.items() if i < len(row) and row[i]]
    return next((k for k in kinds if k in _STIFFENED), "Mass")
