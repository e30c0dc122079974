"""MAC of a test with another, or with the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.matching import mac_between
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.modal.assurance import mac
from ema_pipeline.report.summary_files import finite
from ema_pipeline.run.measured import measured_modes
from ema_pipeline.run.types import Run
from ema_pipeline.stages.results import load_results


@dataclass(frozen=True)
class MacMatrix:
    """MAC of one configuration.

    Attributes
    ----------
    configuration, other : str
        `other` is what stands across: ``"B"`` or ``"the model"``.
    rows_hz, columns_hz : ndarray, (n_a,), (n_b,)
    values : ndarray, (n_a, n_b)
        NaN for a model mode that no sensor sees.
    """

    configuration: str
    other: str
    rows_hz: NDArray[np.float64]
    columns_hz: NDArray[np.float64]
    values: NDArray[np.float64]

    def content(self) -> dict[str, Any]:
        """The same for JSON."""
        return dict(
            finite(
                {
                    "configuration": self.configuration,
                    "a_hz": self.rows_hz.tolist(),
                    "b_hz": self.columns_hz.tolist(),
                    "mac": self.values.tolist(),
                }
            )
        )


def mac_with_test(a: Run, b: Run) -> list[MacMatrix]:
    """MAC of the modes of two tests at the DOFs that both measured.

    Raises
    ------
    EmaError
        If no configuration of both has two DOFs in common.
    """
    of_a, of_b = measured_modes(a), measured_modes(b)
    found = []
    for c in (c for c in of_a if c in of_b):
        values = mac_between(of_a[c], of_b[c])
        if values is not None:
            found.append(MacMatrix(c, "B", of_a[c].frequency_hz, of_b[c].frequency_hz, values))
    if not found:
        raise EmaError(
            f"{a.store.folder} and {b.store.folder}: fewer than two measured DOFs in common; MAC needs two"
        )
    return found


def mac_with_model(run: Run) -> list[MacMatrix]:
    """MAC of the measured modes with those of the fitted model, or of the rig as it is where nothing was fitted.

    Raises
    ------
    EmaError
        If the run has no rig, or fewer than two DOFs.
    """
    model = run.require_model("mac")
    systems = {c: model.system(c, {}) for c in run.info.configurations}
    if run.built_rig is None:
        systems |= {c.name: c.system for c in load_results(run).configurations if c.system is not None}
    found = []
    for name, modes in measured_modes(run).items():
        system = systems[name]
        if modes.shapes is None or len(modes.dofs) < 2:
            continue
        hz, shapes = normal_modes(system)
        read = sensor_rows(system, modes.dofs) @ shapes
        found.append(MacMatrix(name, "the model", modes.frequency_hz, hz, mac(modes.shapes, read.T)))
    if not found:
        raise EmaError(f"{run.store.folder}: fewer than two measured DOFs; MAC needs two")
    return found
