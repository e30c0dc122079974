"""A results folder: what `ema run` writes, opened in Python."""

from __future__ import annotations

import builtins
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ema_pipeline.api import arguments
from ema_pipeline.api.diagnosis import Diagnosis
from ema_pipeline.api.display import Report
from ema_pipeline.api.fits import Fit, fitted
from ema_pipeline.api.frfs import Frfs, frfs_of
from ema_pipeline.api.ladder import Ladder
from ema_pipeline.api.modes import Modes, modes_of
from ema_pipeline.api.work import Settings, Work, overrides
from ema_pipeline.choosing import change_choices, excluding, including
from ema_pipeline.errors import EmaError
from ema_pipeline.files import reason
from ema_pipeline.job import adding, change_effects, removing, run_raw
from ema_pipeline.report.results import RunResults
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.types import Run
from ema_pipeline.stages.results import load_results

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType


@dataclass(frozen=True, repr=False)
class Results(Report):
    """A results folder as it was when it was opened.

    What its properties give is a copy: only `add`, `remove`, `exclude` and `include` change the folder.

    Attributes
    ----------
    folder : Path
    everything : RunResults
        All results at once, as the report reads them.
    """

    folder: Path
    everything: RunResults
    _run: Run
    _effect_files: tuple[str, ...]

    @property
    def configurations(self) -> tuple[str, ...]:
        """Names of the configurations."""
        return self._run.info.configurations

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that were added to the model, ``id@place``."""
        return self._run.info.effects

    @property
    def summary(self) -> dict[str, Any]:
        """The content of ``summary.json``; EmaError where it cannot be read."""
        path = self.folder / "summary.json"
        try:
            with builtins.open(path, encoding="utf-8") as file:
                content: dict[str, Any] = json.load(file)
        except (OSError, ValueError) as error:
            raise EmaError(
                f"{path}: cannot be read ({reason(error)}); write it again with 'ema report {self.folder}'"
            ) from None
        return content

    @property
    def report(self) -> Path:
        """The report, ``report.html``."""
        from ema_pipeline.export import report_path

        return report_path(self.folder)

    @property
    def frfs(self) -> Frfs:
        """The FRFs; EmaError where there are none."""
        self._need("FRFs", any(c.frfs is not None for c in self.everything.configurations))
        return frfs_of(self._work())

    @property
    def modes(self) -> Modes:
        """The modes; EmaError where there are none."""
        self._need("modes", any(c.modal is not None for c in self.everything.configurations))
        return modes_of(self._work())

    @property
    def fit(self) -> Fit:
        """The fitted model with the effects that were added; EmaError where there is none."""
        self._need("fitted model", self.everything.fit is not None)
        return fitted(self._work())

    @property
    def diagnosis(self) -> Diagnosis:
        """What the model is missing; EmaError where that was not asked."""
        found = self.everything.diagnosis
        if found is None:
            raise EmaError(f"{self.folder}: holds no diagnosis; run it with a rig")
        return Diagnosis(found, self._work())

    @property
    def ladder(self) -> Ladder:
        """The ladder of the effects that were added, or else of what the diagnosis supports."""
        shown = self.everything.shown_ladder
        if shown is None:
            raise EmaError(f"{self.folder}: holds no ladder; run it with a rig")
        return Ladder(shown)

    def _need(self, what: str, there: bool) -> None:
        if not there:
            raise EmaError(f"{self.folder}: holds no {what}")

    def add(self, *effects: str) -> Results:
        """Add effects ``id@place`` to the model in the folder, refit, and write its report again."""
        change_effects(self.folder, adding(arguments.effects(effects)), effect_files=self._effect_files)
        return open(self.folder, effect_files=self._effect_files)

    def remove(self, effect: str) -> Results:
        """Take an added effect out of the model in the folder again."""
        change_effects(self.folder, removing(*arguments.effects([effect])), effect_files=self._effect_files)
        return open(self.folder, effect_files=self._effect_files)

    def exclude(self, *, hits: Sequence[str] = (), modes: Sequence[str] = ()) -> Results:
        """Leave hits and modes out in the folder, refit, and write its report again; raw data stay as they are.

        Parameters
        ----------
        hits : sequence of str
            ``"configuration/file#number"``; the number may be left out where the file holds one hit, the configuration
            where there is one.
        modes : sequence of str
            ``"configuration:hertz"``, to within 1 %.
        """
        change_choices(self.folder, excluding(*_named(hits, modes)), effect_files=self._effect_files)
        return open(self.folder, effect_files=self._effect_files)

    def include(self, *, hits: Sequence[str] = (), modes: Sequence[str] = ()) -> Results:
        """Take modes in from the stabilisation chart, or what was excluded; parameters are those of `exclude`."""
        change_choices(self.folder, including(*_named(hits, modes)), effect_files=self._effect_files)
        return open(self.folder, effect_files=self._effect_files)

    def table(self) -> pd.DataFrame:
        """One row per measured mode, beside its model mode: the content of ``modes.csv``."""
        import pandas as pd

        from ema_pipeline.exchange.tables import MODES_COLUMNS, modes_table

        rows = [
            row
            for c in self.everything.configurations
            if c.modal is not None
            for row in modes_table(c.modal, c.name, c.pairing)
        ]
        return pd.DataFrame(rows, columns=list(MODES_COLUMNS))

    def _work(self) -> Work:
        return Work.copy_of(self._run.store, self._run.info, self._effect_files)

    def _screen(self) -> RenderableType:
        return "\n".join(self._headline())

    def _headline(self) -> Sequence[str]:
        from ema_pipeline.report.summary import findings

        return [self.everything.title, *findings(self.everything)]


def _named(hits: Sequence[str], modes: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Hits and modes as texts."""
    return (
        arguments.texts("hits", hits, "a list of texts 'configuration/file#number'"),
        arguments.texts("modes", modes, "a list of texts 'configuration:hertz'"),
    )


def run(
    raw: str | Path,
    *,
    rig: str | Path | None = None,
    out: str | Path | None = None,
    pipeline: str | Path | None = None,
    effect_files: Iterable[str | Path] = (),
    settings: Settings | None = None,
) -> Results:
    """Run a whole pipeline on a raw folder, as the command ``ema run`` does; unchanged stages are skipped.

    Parameters
    ----------
    raw : str or Path
        Raw folder.
    rig : str or Path, optional
        Name of a rig or a rig file; where left out, what the raw folder names. (A rig built in Python cannot be kept
        with the results: use `read`, `identify` and `diagnose` with it.)
    out : str or Path, optional
        Results folder; ``results/<name of raw>`` where left out.
    pipeline : str or Path, optional
        Name of a pipeline that ships with the program, or a TOML file.
    effect_files : iterable of str or Path
        Python files with effects of your own; their code runs.
    settings : mapping of str to value, optional
        Settings by their dotted name, e.g. ``{"frf.estimator": "H2"}``.

    Returns
    -------
    Results

    Raises
    ------
    EmaError
        Whatever is wrong with data or settings, in one line.

    Examples
    --------
    >>> done = ema.run(raw, rig="frame", out=out)  # doctest: +SKIP
    >>> done.diagnosis.verdict  # doctest: +SKIP
    'effect'
    """
    if rig is not None and not isinstance(rig, str | Path):
        raise EmaError(
            "a rig built in Python cannot be kept with the results; give run() a rig file, or use read(), identify() "
            "and diagnose()"
        )
    raw = arguments.path("raw", raw)
    folder = arguments.path("out", out) if out is not None else Path("results") / raw.resolve().name
    files = arguments.effect_files(effect_files)
    run_raw(
        raw,
        None if rig is None else str(rig),
        folder,
        None if pipeline is None else str(pipeline),
        overrides(settings),
        effect_files=files,
    )
    return open(folder, effect_files=files)


def open(out: str | Path, *, effect_files: Iterable[str | Path] = ()) -> Results:
    """Open a results folder.

    Parameters
    ----------
    out : str or Path
        Results folder.
    effect_files : iterable of str or Path
        Files with effects of your own that the results were made with; their code runs.

    Raises
    ------
    EmaError
        If the folder holds no results, or they cannot be read.
    """
    files = arguments.effect_files(effect_files)
    folder = arguments.path("out", out)
    found = existing_run(folder, files)
    return Results(folder, load_results(found), found, files)
