"""A model fitted to measured modes, with or without added effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ema_pipeline.api import arguments
from ema_pipeline.api.arguments import expect
from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.api.ladder import Ladder
from ema_pipeline.api.modes import Modes
from ema_pipeline.api.work import Settings, Work
from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.diagnose import types as diagnosed
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.types import FitResult, ParameterEstimate
from ema_pipeline.job import adding, removing
from ema_pipeline.kinds import kind_of
from ema_pipeline.store import ALL

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType

    from ema_pipeline.rigs.types import Rig


@dataclass(frozen=True, repr=False)
class Fit(Report):
    """A fitted model beside the measurement.

    Attributes
    ----------
    result : FitResult
        Everything that the fit found: estimates, correlation, error, the seed's error function.
    comparison : Comparison
        Measurement minus model for every pair of modes, DOF and band.
    pairings : dict of str to Pairing
        Which measured mode is which model mode, by configuration.
    effects : tuple of str
        Effects in the model, ``id@place``.
    """

    result: FitResult
    comparison: Comparison
    pairings: Mapping[str, Pairing]
    effects: tuple[str, ...]
    _ladder: diagnosed.Ladder | None
    _work: Work

    @property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """Parameters by name: value, standard deviation, interval, unit, whether the data identify it."""
        return self.result.parameters

    @property
    def error(self) -> float:
        """Root mean square of (measurement - model)/standard uncertainty, about 1 where the model explains the data."""
        return self.result.error

    @property
    def frequency_error(self) -> float:
        """The error function ε = Σ((ω_measured - ω_model)/ω_model)² over the paired modes."""
        return self.result.frequency_error

    def table(self) -> pd.DataFrame:
        """One row per parameter, SI, standard deviations 1 σ."""
        import pandas as pd

        rows = [
            (p.name, p.value, p.std, p.low, p.high, p.unit, p.nominal, p.prior_std, p.identified, p.note)
            for p in self.parameters.values()
        ]
        columns = [
            "parameter", "value", "std", "low", "high", "unit", "nominal", "nominal_std", "identified", "note",
        ]  # fmt: skip
        return pd.DataFrame(rows, columns=columns)

    def modes_table(self) -> pd.DataFrame:
        """One row per pair of measured and model mode: both frequencies and dampings, MAC, differences in σ."""
        import pandas as pd

        return pd.DataFrame([vars(m) for m in self.comparison.modes])

    def plot(self, ax: Axes | None = None) -> Axes:
        """Every parameter over its nominal value, fitted and nominal, with 1 σ.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        """
        shown = [p for p in self.parameters.values() if p.nominal]
        ax = axes_or_new(ax, 0.8 + 0.25 * len(shown))
        ax.axvline(1, color="0.8", lw=1)
        for at, p in enumerate(shown):
            if p.prior_std > 0:
                ax.errorbar(
                    1, at + 0.12, xerr=p.prior_std / abs(p.nominal), fmt="s", color="0.6", mfc="white"
                )
            std = p.std / abs(p.nominal) if p.std >= 0 else 0.0
            fill = "C0" if p.identified else "white"
            ax.errorbar(p.value / p.nominal, at - 0.12, xerr=std, fmt="o", color="C0", mfc=fill)
        ax.plot([], [], "s", color="0.6", mfc="white", label="nominal")
        ax.plot([], [], "o", color="C0", label="fitted, identified by the data")
        ax.plot([], [], "o", color="C0", mfc="white", label="fitted, not identified")
        ax.set_yticks(range(len(shown)), [p.name.replace("_", " ") for p in shown])
        ax.set_xlabel("value over nominal value")
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize="small", frameon=False)
        return ax

    def add(self, *effects: str) -> Fit:
        """The model with effects ``id@place`` added, fitted anew.

        Raises
        ------
        EmaError
            For effects or places that the rig does not have.
        """
        return fitted(self._work.with_effects(adding(arguments.effects(effects))(self.effects)))

    def remove(self, effect: str) -> Fit:
        """The model without an effect that was added."""
        return fitted(self._work.with_effects(removing(*arguments.effects([effect]))(self.effects)))

    def ladder(self) -> Ladder:
        """The base model and every added effect, each with its error on the data fitted and held out.

        Raises
        ------
        EmaError
            If nothing was added.
        """
        if self._ladder is None:
            raise EmaError("the model has no added effects; add one with .add('EFFECT@PLACE')")
        return Ladder(self._ladder)

    def _screen(self) -> RenderableType:
        from rich.console import Group

        from ema_pipeline.report import terminal

        columns = ["parameter", "value", "std", "unit", "nominal", "identified"]
        parameters = self.table()[columns].to_string(index=False, float_format="{:.5g}".format)
        return Group(*self._headline(), "", parameters, "", terminal.comparison_tables(self.comparison))

    def _headline(self) -> Sequence[str]:
        added = f" with {', '.join(self.effects)}" if self.effects else ""
        error = f"{self.result.data_count} data; error {self.error:.3g}, ε {self.frequency_error:.3g}"
        return [f"Fitted model{added}", error, *self.result.notes]


def fit(
    rig: Rig | str | Path,
    modes: Modes,
    *,
    effects: Sequence[str] = (),
    effect_files: Iterable[str | Path] = (),
    settings: Settings | None = None,
) -> Fit:
    """Fit the model's parameters to all modes of all configurations.

    How much parts, channels and damping scatter is learned first, by the diagnosis, so that an error is the same number
    wherever it stands; `diagnose` with the same arguments then costs nothing more.

    Parameters
    ----------
    rig : Rig, str or Path
        A rig, the name of one that ships with the program, or a rig file.
    modes : Modes
    effects : sequence of str
        Effects ``id@place`` to add to the rig's model.
    effect_files : iterable of str or Path
        Python files with effects of your own; their code runs.
    settings : mapping of str to value, optional
        Settings by their dotted name, e.g. ``{"fit.narrowed": 0.5}``.

    Returns
    -------
    Fit

    Raises
    ------
    EmaError
        If rig and modes do not belong together, or there is nothing to fit.

    Examples
    --------
    >>> fit = ema.fit(rig, modes)
    >>> fit.parameters["storey1_stiffness"].unit
    'N/m'
    >>> list(fit.table().columns[:3])
    ['parameter', 'value', 'std']
    """
    added = adding(arguments.effects(effects))(())
    work = checked(modes, rig, settings, effect_files)
    work.run("diagnose")
    return fitted(work.with_effects(added))


def checked(
    modes: Modes, rig: Rig | str | Path, settings: Settings | None, effect_files: Iterable[str | Path]
) -> Work:
    """Modes beside a rig.

    Raises
    ------
    EmaError
        If the rig does not know a DOF that was measured.
    """
    expect("modes", modes, Modes, "modes, as ema.identify(frfs) gives them")
    work = modes._work.with_rig(rig, settings, effect_files)
    model = work.look().rig
    assert model is not None
    for name, modal in zip(work.info.configurations, modes.models.values(), strict=True):
        for dof in modal.dofs:
            if not model.knows(name, dof):
                raise EmaError(f"rig '{model.name}' ({name}) has no dof '{dof.point}', which was measured")
    return work


def fitted(work: Work) -> Fit:
    """Fit, compare and, where effects were added, measure the ladder."""
    work.look().require_model("fit")  # refuses unknown effects and places before anything is computed
    if work.info.effects:
        work.with_effects(()).run("ladder", "fit")  # as the commands do: a run fits the base model first
    run = work.run("ladder", "fit", "correlate")
    found = run.store.find("fit", ALL, "fit", FitResult)
    if found is None:
        what = kind_of(run.info).words
        raise EmaError(
            f"a model judged by {what} is not fitted to modes; use ema.open(out).add(...) and its ladder"
        )
    names = run.info.configurations
    return Fit(
        found,
        run.store.load("correlate", ALL, "comparison", Comparison),
        {name: run.store.load("correlate", ALL, f"pairing {name}", Pairing) for name in names},
        run.info.effects,
        run.store.find("ladder", ALL, "ladder", diagnosed.Ladder),
        work,
    )
