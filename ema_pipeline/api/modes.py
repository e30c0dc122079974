"""Modes identified from FRFs, each with its uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.api.arguments import expect, path
from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.api.frfs import Frfs
from ema_pipeline.api.work import MADE_FRFS, Settings, Work, overrides
from ema_pipeline.describe import describe_modes
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType

ROOM = 1.2
"""A plot ends at this many times the highest mode's frequency."""


@dataclass(frozen=True, repr=False)
class Modes(Report):
    """Modes of all configurations; ``modes["no_ring"]`` are those of one.

    Attributes
    ----------
    models : dict of str to ModalModel
        Everything identified in every configuration: poles, shapes, circles, chart, what was left out.
    """

    models: Mapping[str, ModalModel]
    _frfs: Mapping[str, FrfSet]
    _work: Work

    @property
    def configurations(self) -> tuple[str, ...]:
        """Names of the configurations."""
        return tuple(self.models)

    def __getitem__(self, configuration: str) -> Modes:
        work = self._work.only(configuration)
        frfs = {name: f for name, f in self._frfs.items() if name == configuration}
        return Modes({configuration: self.models[configuration]}, frfs, work)

    def __iter__(self) -> Iterator[str]:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Undamped natural frequencies, (n_modes,)."""
        return np.array([m.frequency_hz for m in self._one().modes])

    @property
    def damping_ratio(self) -> NDArray[np.float64]:
        """Damping ratios, (n_modes,)."""
        return np.array([m.damping_ratio for m in self._one().modes])

    @property
    def frequency_std_hz(self) -> NDArray[np.float64]:
        """Standard deviations of `frequency_hz`, 1 σ, (n_modes,)."""
        return np.array([m.frequency_std_hz for m in self._one().modes])

    @property
    def damping_std(self) -> NDArray[np.float64]:
        """Standard deviations of `damping_ratio`, 1 σ, (n_modes,)."""
        return np.array([m.damping_std for m in self._one().modes])

    @property
    def dofs(self) -> tuple[str, ...]:
        """DOFs of the rows of `shapes`."""
        return tuple(d.point for d in self._one().dofs)

    @property
    def shapes(self) -> NDArray[np.complex128]:
        """Complex mode shapes, (n_dofs, n_modes); mass-normalised where a driving point was measured."""
        one = self._one()
        return (
            np.stack([m.shape for m in one.modes], axis=1)
            if one.modes
            else np.zeros((len(one.dofs), 0), complex)
        )

    def _one(self) -> ModalModel:
        if len(self.models) > 1:
            names = ", ".join(self.models)
            raise EmaError(f"these are modes of {names}; choose one, e.g. modes['{next(iter(self.models))}']")
        return next(iter(self.models.values()))

    def table(self) -> pd.DataFrame:
        """One row per mode: frequency, damping, their standard deviations, phase collinearity, remarks."""
        import pandas as pd

        from ema_pipeline.exchange.tables import MODES_COLUMNS, modes_table

        rows = [row for name, modal in self.models.items() for row in modes_table(modal, name)]
        of_a_model = ("model_mode", "model_frequency_hz", "mac", "family")
        return pd.DataFrame(rows, columns=[c for c in MODES_COLUMNS if c not in of_a_model])

    def plot(self, ax: Axes | None = None) -> Axes:
        """The complex mode indicator function of every configuration with a line at every mode.

        Damping over frequency where there are no FRFs.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        """
        ax = axes_or_new(ax)
        for colour, name in enumerate(self.models):
            self[name]._draw(ax, f"C{colour}", name)
        if self._frfs:
            ax.set_yscale("log")
        ax.set_ylabel("mode indicator, (m/s²)/N" if self._frfs else "damping ratio, %")
        ax.set_xlabel("frequency, Hz")
        if len(self.models) > 1:
            ax.legend()
        return ax

    def _draw(self, ax: Axes, colour: str, name: str) -> None:
        modal, frfs = self._one(), next(iter(self._frfs.values()), None)
        if frfs is None:
            std = 100 * self.damping_std
            ax.errorbar(self.frequency_hz, 100 * self.damping_ratio, std, fmt="o", color=colour, label=name)
            return
        from ema_pipeline.frf.overview import cmif

        low, high = modal.band_hz
        high = min(high, ROOM * max(self.frequency_hz, default=high))
        band = (frfs.frequency_hz >= low) & (frfs.frequency_hz <= high)
        first, *others = cmif(frfs.accelerance()[..., band], 2)
        ax.plot(frfs.frequency_hz[band], first, lw=1.2, color=colour, label=name)
        for other in others:
            ax.plot(frfs.frequency_hz[band], other, lw=0.7, color=colour)
        for number, frequency_hz in enumerate(self.frequency_hz, start=1):
            ax.axvline(frequency_hz, color=colour, lw=0.6, ls="--")
            top = ax.get_xaxis_transform()
            ax.text(
                frequency_hz, 1.01, str(number), transform=top, ha="center", fontsize="small", color=colour
            )

    def _screen(self) -> RenderableType:
        from rich.console import Group

        from ema_pipeline.report import terminal

        return Group(*(terminal.modes_table(modal, name) for name, modal in self.models.items()))

    def _headline(self) -> Sequence[str]:
        lines = [
            f"{name}: {len(m.modes)} modes between {m.band_hz[0]:.4g} and {m.band_hz[1]:.4g} Hz"
            for name, m in self.models.items()
        ]
        return ["Modes", *lines]


def identify(frfs: Frfs, *, settings: Settings | None = None) -> Modes:
    """Identify the modes of FRFs, with uncertainties, and what moves with the force of the hits.

    Parameters
    ----------
    frfs : Frfs
    settings : mapping of str to value, optional
        Settings by their dotted name, e.g. ``{"modal.method": "circle"}``.

    Returns
    -------
    Modes

    Raises
    ------
    EmaError
        If there is nothing to identify, in one line.

    Examples
    --------
    >>> frfs = test.frfs()
    >>> frfs.h.shape
    (3, 3, 4801)
    >>> modes = ema.identify(frfs)
    >>> modes.frequency_hz.round(0)
    array([17., 40., 59.])
    >>> modes.shapes.shape
    (3, 3)
    """
    expect("frfs", frfs, Frfs, "FRFs, as test.frfs() gives them")
    work = frfs._work.with_settings(settings, MADE_FRFS)
    work.run("modal", "levels")
    return modes_of(work)


def read_modes(file: str | Path, rig: str | Path) -> Modes:
    """Read a table of modes that another program has identified.

    Parameters
    ----------
    file : str or Path
        CSV or TOML.
    rig : str or Path
        Name of a rig or a rig file: it says what the table's DOFs and configurations are.

    Raises
    ------
    EmaError
        Whatever is wrong with the table, in one line.
    """
    expect("rig", rig, (str, Path), "the name of a rig or the path of a rig file")
    work = Work.new(describe_modes(path("file", file), str(rig), None, overrides(None)))
    work.run("modal")
    return modes_of(work)


def modes_of(work: Work) -> Modes:
    """The modes that a results file holds, as a linear structure."""
    from ema_pipeline.stages.results import load_results

    found = [c for c in load_results(work.without_rig().look()).configurations if c.modal is not None]
    frfs = {c.name: c.frfs for c in found if c.frfs is not None}
    return Modes({c.name: c.modal for c in found if c.modal is not None}, frfs, work)
