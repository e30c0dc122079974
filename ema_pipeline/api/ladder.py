"""The ladder of models: the base model, and every effect added on top, each with its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.diagnose import types
from ema_pipeline.diagnose.types import Rung

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType


@dataclass(frozen=True, repr=False)
class Ladder(Report):
    """Models from the base model upwards, measured on the same data with the same uncertainties.

    Attributes
    ----------
    result : ema_pipeline.diagnose.types.Ladder
        The rungs, and what σ holds.
    """

    result: types.Ladder

    @property
    def rungs(self) -> tuple[Rung, ...]:
        """The models: effects, error fitted and held out, parameters, evidence."""
        return self.result.rungs

    def table(self) -> pd.DataFrame:
        """One row per model: its effects, error on the data fitted and held out, evidence."""
        import pandas as pd

        rows = [
            (" ".join(r.effects), r.error, r.heldout_error, r.unexplained, r.log_evidence)
            for r in self.result.rungs
        ]
        columns = ["effects", "error", "heldout_error", "unexplained_modes", "log_evidence"]
        return pd.DataFrame(rows, columns=columns)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Error of every model on the data fitted and on data held out; about 1 where it explains them.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        """
        from ema_pipeline.report.diagnosis import rung_words

        ax, rungs = axes_or_new(ax), self.result.rungs
        at = range(len(rungs))
        ax.axhline(1, color="0.5", ls=":", lw=1, label="explained")
        ax.plot(at, [r.error for r in rungs], "o-", label="data fitted")
        ax.plot(at, [r.heldout_error for r in rungs], "s--", mfc="white", label="data held out")
        before: list[tuple[str, ...]] = [(), *(r.effects for r in rungs[:-1])]
        ax.set_xticks(at, [rung_words(b, r.effects) for b, r in zip(before, rungs, strict=True)])
        ax.margins(x=0.2)
        ax.set_yscale("log")
        ax.set_ylabel("error, σ root mean square")
        ax.legend()
        return ax

    def _screen(self) -> RenderableType:
        from ema_pipeline.report.terminal import ladder_screen

        return ladder_screen(self.result)

    def _headline(self) -> Sequence[str]:
        from ema_pipeline.report.diagnosis import noise_words

        return ["Ladder of models", noise_words(self.result)]
