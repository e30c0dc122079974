"""A continuous test as it was recorded: measured forces and responses in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.api.frfs import Frfs, frfs_of
from ema_pipeline.api.work import Settings, Work
from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.run.records import driven_records

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType


@dataclass(frozen=True, repr=False)
class ContinuousTest(Report):
    """Records of a raw folder with `kind = "continuous"`.

    Attributes
    ----------
    title : str
    configurations : tuple of str
    """

    title: str
    configurations: tuple[str, ...]
    _work: Work

    @cached_property
    def records(self) -> dict[str, tuple[DrivenRecord, ...]]:
        """Records of every configuration in SI units: `force` (n_forces, n_samples), `responses` likewise."""
        return {name: driven_records(self._work.store, name) for name in self.configurations}

    def frfs(self, settings: Settings | None = None) -> Frfs:
        """Frequency response functions of all forces at once, from the records that are not held out.

        Parameters
        ----------
        settings : mapping of str to value, optional
            Settings by their dotted name, e.g. ``{"frf.estimator": "Hv"}``.

        Raises
        ------
        EmaError
            If the records do not tell the forces apart, in one line.
        """
        work = self._work.with_settings(settings)
        work.run("frf")
        return frfs_of(work)

    def table(self) -> pd.DataFrame:
        """One row per record and force: what it drives, its root mean square in N, and what the record is used for."""
        import pandas as pd

        rows = [
            (name, r.name, r.excitation, r.use, r.n_samples, r.period, f.dof.point, float(np.std(samples)))
            for name, records in self.records.items()
            for r in records
            for f, samples in zip(r.forces, r.force, strict=True)
        ]
        columns = [
            "configuration",
            "record",
            "excitation",
            "use",
            "samples",
            "period",
            "drives",
            "rms_force_n",
        ]
        return pd.DataFrame(rows, columns=columns)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Power spectral density of every force in every record; those held out are dashed.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        """
        from scipy.signal import welch

        ax = axes_or_new(ax)
        several = len(self.configurations) > 1
        for name, records in self.records.items():
            for r in records:
                block = r.period or min(r.n_samples, 2048)
                window = "boxcar" if r.period else "hann"
                for force, samples in zip(r.forces, r.force, strict=True):
                    frequency, power = welch(samples, r.sample_rate_hz, window, block)
                    label = f"{name}: " * several + f"{r.name}, {force.dof.point}"
                    ax.plot(frequency[1:], power[1:], "--" if r.held_out else "-", lw=1, label=label)
        ax.set_yscale("log")
        ax.set_xlabel("frequency, Hz")
        ax.set_ylabel("power spectral density of the force, N²/Hz")
        ax.legend()
        return ax

    def _screen(self) -> RenderableType:
        return self.table().to_string(index=False, float_format="{:.4g}".format)

    def _headline(self) -> Sequence[str]:
        lines = []
        for name, records in self.records.items():
            held_out = sum(r.held_out for r in records)
            forces = ", ".join(f.dof.point for f in records[0].forces)
            lines.append(f"{name}: {len(records)} records, {held_out} held out, driven at {forces}")
        return [self.title or "Continuous test", *lines]
