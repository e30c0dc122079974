"""Frequency response functions of a test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.api.work import Work
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.frf.types import FrfSet

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType

SHOWN = 6
"""FRFs in a plot where none is named: more curves cannot be told apart."""


@dataclass(frozen=True, repr=False)
class Frfs(Report):
    """FRFs of all configurations; ``frfs["no_ring"]`` are those of one.

    Attributes
    ----------
    sets : dict of str to FrfSet
        Everything known of the FRFs of every configuration: hits averaged, windows, band, checks.
    """

    sets: Mapping[str, FrfSet]
    _work: Work

    @property
    def configurations(self) -> tuple[str, ...]:
        """Names of the configurations."""
        return tuple(self.sets)

    def __getitem__(self, configuration: str) -> Frfs:
        work = self._work.only(configuration)
        return Frfs({configuration: self.sets[configuration]}, work)

    def __iter__(self) -> Iterator[str]:
        return iter(self.sets)

    def __len__(self) -> int:
        return len(self.sets)

    @property
    def h(self) -> NDArray[np.complex128]:
        """Response over force, SI, (n_outputs, n_inputs, n_lines); NaN where not measured."""
        return self._one().frf

    @property
    def coherence(self) -> NDArray[np.float64]:
        """Ordinary coherence, (n_outputs, n_inputs, n_lines); NaN where one hit only was averaged."""
        return self._one().coherence

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of `h` from the scatter over hits or blocks, (n_outputs, n_inputs, n_lines)."""
        return self._one().variance

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Frequency lines, (n_lines,)."""
        return self._one().frequency_hz

    @property
    def outputs(self) -> tuple[str, ...]:
        """DOFs of the responses."""
        return tuple(d.point for d in self._one().outputs)

    @property
    def inputs(self) -> tuple[str, ...]:
        """DOFs that were struck or driven."""
        return tuple(d.point for d in self._one().inputs)

    def _one(self) -> FrfSet:
        if len(self.sets) > 1:
            names = ", ".join(self.sets)
            raise EmaError(f"these are FRFs of {names}; choose one, e.g. frfs['{next(iter(self.sets))}']")
        return next(iter(self.sets.values()))

    def table(self) -> pd.DataFrame:
        """One row per FRF: hits averaged, and mean coherence in the band that the force excites."""
        import pandas as pd

        rows = []
        for name, s in self.sets.items():
            band = (s.frequency_hz >= s.band_hz[0]) & (s.frequency_hz <= s.band_hz[1])
            for o, output in enumerate(s.outputs):
                for i, struck in enumerate(s.inputs):
                    if s.hits[o, i]:
                        coherence = float(np.mean(s.coherence[o, i, band]))
                        row = (
                            name,
                            output.point,
                            struck.point,
                            s.quantities[o],
                            int(s.hits[o, i]),
                            coherence,
                        )
                        rows.append(row)
        return pd.DataFrame(
            rows, columns=["configuration", "output", "input", "quantity", "hits", "mean_coherence"]
        )

    def plot(self, ax: Axes | None = None, pairs: Sequence[tuple[str, str]] | None = None) -> Axes:
        """Magnitude of accelerances in the band that the force excites.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        pairs : sequence of (output, input), optional
            DOFs of the FRFs, of every configuration; the first driving points where left out.

        Raises
        ------
        EmaError
            For an FRF that was not measured.
        """
        ax = axes_or_new(ax)
        for name in self.sets:
            one = self[name]
            at = f"{name}: " if len(self.sets) > 1 else ""
            measured = one._one()
            band = (one.frequency_hz >= measured.band_hz[0]) & (one.frequency_hz <= measured.band_hz[1])
            accelerance = measured.accelerance()
            for output, struck in one._pairs(pairs, max(1, SHOWN // len(self.sets))):
                h = np.abs(accelerance[one.outputs.index(output), one.inputs.index(struck), band])
                ax.plot(one.frequency_hz[band], h, label=f"{at}{output} / {struck}", lw=1)
        calibrated = all(s.force_calibrated for s in self.sets.values())
        ax.set_yscale("log")
        ax.set_xlabel("frequency, Hz")
        ax.set_ylabel("accelerance, (m/s²)/N" if calibrated else "accelerance, (m/s²)/V")
        ax.legend()
        return ax

    def _pairs(self, pairs: Sequence[tuple[str, str]] | None, most: int) -> Sequence[tuple[str, str]]:
        if pairs is None:
            driving = [(d, d) for d in self.inputs if d in self.outputs]
            return driving[:most] or [(self.outputs[0], self.inputs[0])]
        for output, struck in pairs:
            for dof, known in ((output, self.outputs), (struck, self.inputs)):
                if dof not in known:
                    raise EmaError(
                        f"no FRF {output} / {struck}: '{dof}' was not measured{did_you_mean(dof, known)}"
                    )
        return pairs

    def _screen(self) -> RenderableType:
        return "\n".join(self._headline())

    def _headline(self) -> Sequence[str]:
        lines = []
        for name, s in self.sets.items():
            low, high = s.band_hz
            driven = "forces" if s.excitation else "impact points"
            size = f"{len(s.outputs)} responses × {len(s.inputs)} {driven} × {s.frequency_hz.size} lines"
            lines.append(f"{name}: {size}, excited from {low:.4g} to {high:.4g} Hz, {s.estimator}")
            lines += [f"! {v.message}" for v in s.verdicts if not v.passes and v.message]
        return ["Frequency response functions", *lines]


def frfs_of(work: Work) -> Frfs:
    """The FRFs that a results file holds."""
    names = work.info.configurations
    return Frfs({name: work.store.load("frf", name, "frfs", FrfSet) for name in names}, work)
