"""A test as it was recorded: records and hits in SI units, each hit with its verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ema_pipeline.api.arguments import path
from ema_pipeline.api.continuous import ContinuousTest
from ema_pipeline.api.display import Report, axes_or_new
from ema_pipeline.api.frfs import Frfs, frfs_of
from ema_pipeline.api.work import Settings, Work, overrides
from ema_pipeline.describe import describe
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.records import Hit, Record
from ema_pipeline.kinds import kind_of
from ema_pipeline.run.records import stored_records

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType


@dataclass(frozen=True, repr=False)
class Test(Report):
    """Records and hits of a raw folder.

    Attributes
    ----------
    title : str
    configurations : tuple of str
    hits : dict of str to tuple of Hit
        Hits of every configuration with their verdicts.
    """

    __test__ = False  # pytest: not a class of tests

    title: str
    configurations: tuple[str, ...]
    hits: Mapping[str, tuple[Hit, ...]]
    _work: Work

    @cached_property
    def records(self) -> dict[str, tuple[Record, ...]]:
        """Records of every configuration in SI units; responses are arrays, (n_channels, n_samples)."""
        found = {}
        for name in self.configurations:
            with stored_records(self._work.store, name) as records:
                found[name] = tuple(replace(r, responses=np.asarray(r.responses)) for r in records)
        return found

    def frfs(self, settings: Settings | None = None) -> Frfs:
        """Frequency response functions, averaged over the accepted hits of every impact point.

        Parameters
        ----------
        settings : mapping of str to value, optional
            Settings by their dotted name, e.g. ``{"frf.estimator": "H2"}``.

        Raises
        ------
        EmaError
            If the hits cannot be averaged, in one line.
        """
        work = self._work.with_settings(settings)
        work.run("frf")
        return frfs_of(work)

    def table(self) -> pd.DataFrame:
        """One row per hit: where it struck, its peak force in N, whether it is used, and why not."""
        import pandas as pd

        rows = [
            (name, h.file, h.number, str(h.impact), h.peak_force, h.accepted, h.reason)
            for name, hits in self.hits.items()
            for h in hits
        ]
        columns = ["configuration", "file", "hit", "impact", "peak_force_n", "accepted", "reason"]
        return pd.DataFrame(rows, columns=columns)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Peak force of every hit by impact point; rejected hits are crosses.

        Parameters
        ----------
        ax : Axes, optional
            Axes to draw on; those of a new pyplot figure where left out.
        """
        ax = axes_or_new(ax)
        table = self.table()
        several = len(self.configurations) > 1
        point = table["configuration"] + " " + table["impact"] if several else table["impact"]
        for accepted, marker, label in ((True, "o", "used"), (False, "x", "rejected")):
            chosen = table["accepted"] == accepted
            if chosen.any():
                ax.plot(point[chosen], table.loc[chosen, "peak_force_n"].abs(), marker, label=label)
        ax.set_ylabel("peak force, N")
        ax.tick_params(axis="x", rotation=45)
        ax.legend()
        return ax

    def _screen(self) -> RenderableType:
        from rich.console import Group

        from ema_pipeline.report import terminal

        return Group(*(terminal.hits_table(hits, name) for name, hits in self.hits.items()))

    def _headline(self) -> Sequence[str]:
        used = [
            f"{name}: {sum(h.accepted for h in hits)} of {len(hits)} hits used"
            for name, hits in self.hits.items()
        ]
        return [self.title or "Test", *used]


def read(
    raw: str | Path, *, pipeline: str | Path | None = None, settings: Settings | None = None
) -> Test | ContinuousTest:
    """Read a raw folder: records in SI units, and of a hammer test the hits found in them with their verdicts.

    Parameters
    ----------
    raw : str or Path
        Folder with ``test.toml`` and the record files, or with one such folder per configuration.
    pipeline : str or Path, optional
        Name of a pipeline that ships with the program, or a TOML file.
    settings : mapping of str to value, optional
        Settings by their dotted name, e.g. ``{"hits.trigger_level": 0.2}``; they hold for all that is made of the test.

    Returns
    -------
    Test or ContinuousTest
        By the `kind` that the folder states.

    Raises
    ------
    EmaError
        Whatever is wrong with the files, in one line that names file and channel.

    Examples
    --------
    >>> test = ema.read(raw)
    >>> test.configurations
    ('default',)
    >>> bool(test.table()["accepted"].all())
    True
    >>> bool(test.records["default"][0].force.max() > 100)  # N
    True
    """
    info = describe(path("raw", raw), None, None if pipeline is None else str(pipeline), overrides(settings))
    kind = kind_of(info)
    if "frf" not in kind.measures:
        raise EmaError(f"{raw}: holds {kind.words}, which have no FRFs; use ema.run({str(raw)!r})")
    work = Work.new(info)
    if "hits" not in kind.measures:
        work.run("ingest")
        return ContinuousTest(info.title, info.configurations, work)
    run = work.run("ingest", "hits")
    hits = {name: run.store.load("hits", name, "hits", tuple[Hit, ...]) for name in info.configurations}
    return Test(info.title, info.configurations, hits, work)
