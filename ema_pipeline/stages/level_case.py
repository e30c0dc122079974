"""What the store holds of a test at several force levels, for the stages that simulate its hits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ema_pipeline.diagnose.hypotheses import Hypothesis, make_rig
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.ingest.records import Hit
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Run
from ema_pipeline.stages.hits import stored_records
from ema_pipeline.stages.levels import level_studies

if TYPE_CHECKING:
    from ema_pipeline.diagnose.levels.case import LevelCase
    from ema_pipeline.diagnose.levels.prepare import LevelTest


def all_tests(run: Run) -> tuple[LevelTest, ...]:
    """All configurations with their force levels; none for a table of modes."""
    from ema_pipeline.diagnose.levels.prepare import LevelTest

    return tuple(
        LevelTest(name, study, run.store.load("modal", name, "modal", ModalModel))
        for name, study in level_studies(run).items()
    )


def level_case(run: Run, tests: Sequence[LevelTest], starts: Sequence[Mapping[str, float]]) -> LevelCase:
    """The rig without effects and windows after the hits of every level."""
    from ema_pipeline.diagnose.levels.case import LevelCase
    from ema_pipeline.diagnose.levels.prepare import common_levels, highest_mode, windows_of

    assert run.rig is not None
    settings = DiagnoseSettings()
    forces = common_levels(tests)
    windows = []
    for test in tests:
        hits = run.store.load("hits", test.configuration, "hits", tuple[Hit, ...])
        with stored_records(run.store, test.configuration) as records:
            pairs = [(r, h) for r in records for h in hits if h.file == r.file and h.accepted]
            windows.append(windows_of(test, pairs, forces, settings.levels))
    return LevelCase(
        run.rig, tuple(windows), settings, run.library, tuple(dict(s) for s in starts), highest_mode(tests)
    )


def linear_part(run: Run) -> Rig:
    """The rig with those of the added effects that do not depend on the level."""
    assert run.rig is not None
    settings = DiagnoseSettings()
    kept = tuple(x for x in run.info.effects if not depends_on_level(x, run.library))
    return make_rig(run.rig, Hypothesis(kept), run.library, settings.parameter_range)


def with_sizes_of(run: Run, rig: Rig, values: Mapping[str, float]) -> Rig:
    """The rig with the sizes of effects that only hits show held at those that a ladder of hits found."""
    held = {
        n: replace(p, value=values[n], free=False, tolerance=0.0)
        for n, p in rig.parameters.items()
        if n in values and n.rpartition(".")[0] in run.info.effects and depends_on_level(n, run.library)
    }
    if not held or not isinstance(rig, ParametricRig):
        return rig
    return replace(rig, parameters={**rig.parameters, **held})
