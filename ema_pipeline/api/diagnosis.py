"""Which physical effect the model is missing, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ema_pipeline.api import arguments
from ema_pipeline.api.arguments import expect
from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.api.fits import Fit, checked, fitted
from ema_pipeline.api.frfs import Frfs
from ema_pipeline.api.ladder import Ladder
from ema_pipeline.api.modes import Modes
from ema_pipeline.api.work import Settings, Work
from ema_pipeline.diagnose import types
from ema_pipeline.diagnose.types import Candidate, VerdictWord
from ema_pipeline.errors import EmaError
from ema_pipeline.job import adding
from ema_pipeline.store import ALL

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType

    from ema_pipeline.rigs.types import Rig


@dataclass(frozen=True, repr=False)
class Diagnosis(Report):
    """The answer to: which physics is the model missing?

    Attributes
    ----------
    result : ema_pipeline.diagnose.types.Diagnosis
        Everything that the diagnosis found, with detection limits and remarks on the data.
    """

    result: types.Diagnosis
    _work: Work

    @property
    def verdict(self) -> VerdictWord:
        """``adequate``, ``effect``, ``ambiguous``, ``unknown_effect`` or ``not_enough_data``."""
        return self.result.verdict

    @property
    def summary(self) -> str:
        """The verdict in one or two sentences."""
        return self.result.summary

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Effects that may be missing, the most probable first."""
        return self.result.candidates

    @property
    def next_measurement(self) -> str:
        """What to measure next; empty where nothing is needed."""
        return self.result.next_measurement

    @property
    def indistinguishable(self) -> tuple[tuple[str, ...], ...]:
        """Groups of effects that these data cannot tell apart."""
        return self.result.indistinguishable

    @property
    def probabilities(self) -> Mapping[str, float]:
        """Probability of every hypothesis, ``"nothing"`` among them; adds up to 1."""
        return self.result.probabilities

    def table(self) -> pd.DataFrame:
        """One row per candidate: probability, error without and with it, fitted and held out."""
        import pandas as pd

        rows = [
            (c.effect, c.at, c.probability, c.error_before, c.error_after, c.heldout_error_after, c.claimed)
            for c in self.candidates
        ]
        columns = [
            "effect", "at", "probability", "error_before", "error_after", "heldout_error_after", "supported",
        ]  # fmt: skip
        return pd.DataFrame(rows, columns=columns)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Probability of every candidate and of nothing missing; what the data support is filled.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        """
        bars = [(c.label, c.probability, c.claimed) for c in self.candidates]
        bars.append(("nothing missing at all", self.result.null_probability, self.verdict == "adequate"))
        ax = axes_or_new(ax, 0.8 + 0.25 * len(bars))
        for at, (_, probability, supported) in enumerate(bars):
            ax.barh(at, probability, 0.6, fc="C0" if supported else "white", ec="C0")
        ax.set_yticks(range(len(bars)), [label for label, _, _ in bars])
        ax.invert_yaxis()
        ax.set_xlim(0, 1)
        ax.set_xlabel("probability")
        return ax

    def add(self, *effects: str) -> Fit:
        """The model with effects ``id@place`` added, fitted anew.

        Raises
        ------
        EmaError
            For effects or places that the rig does not have.
        """
        return fitted(self._work.with_effects(adding(arguments.effects(effects))(self._work.info.effects)))

    def ladder(self) -> Ladder:
        """The base model and what the data support on top of it."""
        return Ladder(self.result.ladder)

    def _screen(self) -> RenderableType:
        from ema_pipeline.report import diagnosis

        found = self.result
        short = {"error_before": "error", "error_after": "with it", "heldout_error_after": "held out"}
        candidates = self.table().rename(columns=short).to_string(index=False, float_format="{:.3g}".format)
        blocks = [
            *self._headline(),
            candidates if found.candidates else "",
            diagnosis.sigma_words(found),
            *diagnosis.reasons(found),
            *diagnosis.group_words(found),
            diagnosis.detection_words(found),
            *(f"! {note}" for note in found.notes),
        ]
        return "\n\n".join(block for block in blocks if block)

    def _headline(self) -> Sequence[str]:
        from ema_pipeline.report.diagnosis import heading

        following = f"Measure next: {self.next_measurement}" if self.next_measurement else ""
        return [heading(self.result), self.summary, *([following] if following else [])]


def diagnose(
    rig: Rig | str | Path,
    modes: Modes,
    frfs: Frfs | None = None,
    *,
    effects: Sequence[str] = (),
    effect_files: Iterable[str | Path] = (),
    settings: Settings | None = None,
) -> Diagnosis:
    """Say which physical effect the model is missing, how sure that is, and what to measure next.

    Parameters
    ----------
    rig : Rig, str or Path
        A rig, the name of one that ships with the program, or a rig file.
    modes : Modes
    frfs : Frfs, optional
        The FRFs that the modes were identified from, which the modes hold already.
    effects : sequence of str
        Effects ``id@place`` that the model has already.
    effect_files : iterable of str or Path
        Python files with effects of your own; their code runs.
    settings : mapping of str to value, optional
        Settings by their dotted name.

    Returns
    -------
    Diagnosis

    Raises
    ------
    EmaError
        If rig, modes and FRFs do not belong together.

    Examples
    --------
    >>> found = ema.diagnose(rig, modes, frfs)
    >>> found.verdict
    'effect'
    >>> better = found.add("spring@storey2")
    >>> [bool(rung.error < 2) for rung in better.ladder().rungs]
    [False, True]
    """
    expect("modes", modes, Modes, "modes, as ema.identify(frfs) gives them")
    expect("frfs", frfs, (Frfs, type(None)), "FRFs, as test.frfs() gives them, or nothing")
    added = adding(arguments.effects(effects))(())
    if frfs is not None and tuple(frfs) != tuple(modes):
        raise EmaError(
            f"the FRFs are of {', '.join(frfs)}, the modes of {', '.join(modes)}; give those of one test"
        )
    work = checked(modes, rig, settings, effect_files).with_effects(added)
    return Diagnosis(work.run("diagnose").store.load("diagnose", ALL, "diagnosis", types.Diagnosis), work)
