"""From the hits, levels and modes of a test to what the time-domain fit works on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.diagnose.levels.data import HitWindows, hit_windows
from ema_pipeline.diagnose.levels.settings import LevelDiagnosisSettings
from ema_pipeline.ingest.records import Hit, Record
from ema_pipeline.levels.types import ForceLevel, LevelStudy
from ema_pipeline.modal.types import ModalModel

_BELOW, _ABOVE = 0.6, 1.15
"""The band begins below the lowest mode and ends above the highest by these factors."""

_NYQUIST = 2.56
"""An analyser's filter leaves signals alone up to the sample rate over this."""

_RIGID_HZ = 3.0
"""Modes below are bodies on soft supports or drift, and last longer than any window."""


@dataclass(frozen=True)
class LevelTest:
    """One configuration with its force levels.

    Attributes
    ----------
    configuration : str
    study : LevelStudy
    modal : ModalModel
        Of all hits together.
    """

    configuration: str
    study: LevelStudy
    modal: ModalModel

    def modes(self, level: int) -> MeasuredModes:
        """Modes of the hits of one level alone; -1 for the hardest."""
        own = self.study.levels[level].modal
        return from_modal_model(self.modal if own is None else own, self.configuration)

    @property
    def levels(self) -> tuple[ForceLevel, ...]:
        """Force levels, from the softest up."""
        return self.study.levels


def windows_of(
    test: LevelTest,
    hits: Iterable[tuple[Record, Hit]],
    force_n: Sequence[float],
    settings: LevelDiagnosisSettings,
) -> HitWindows:
    """Windows after one hit per impact point and level.

    Parameters
    ----------
    test : LevelTest
    hits : iterable of (Record, Hit)
        Accepted hits of the configuration with their records.
    force_n : sequence of float
        Force levels of the whole campaign; the configuration's own are sorted in among them.
    settings : LevelDiagnosisSettings
    """
    modes = test.modes(0)
    hz = modes.frequency_hz[modes.frequency_hz > _RIGID_HZ]
    found = list(hits)
    rate = found[0][0].sample_rate_hz
    band = (_BELOW * float(hz[0]), min(_ABOVE * float(hz[-1]), rate / _NYQUIST))
    at = {
        name: int(np.argmin(np.abs(np.log(np.asarray(force_n) / level.force_n))))
        for level in _some(test.levels)
        for name in level.hits
    }
    points = list(dict.fromkeys(str(h.impact) for _, h in found))
    most = max(settings.most_hits // max(len(set(at.values())), 1), 1)
    kept = set(points[:: int(np.ceil(len(points) / most))])
    chosen = [(r, h) for r, h in found if str(h.impact) in kept]
    return hit_windows(
        chosen, test.configuration, at, force_n, band, settings.periods / float(hz[0]), len(hz)
    )


def _some(levels: Sequence[ForceLevel]) -> list[ForceLevel]:
    """The softest, the hardest and one between."""
    return [levels[i] for i in sorted({0, len(levels) // 2, len(levels) - 1})]


def common_levels(tests: Sequence[LevelTest]) -> tuple[float, ...]:
    """Force levels of all configurations, those within a factor of 1.5 taken together."""
    forces = sorted(level.force_n for t in tests for level in _some(t.levels))
    groups: list[list[float]] = []
    for f in forces:
        if groups and f < 1.5 * groups[-1][0]:
            groups[-1].append(f)
        else:
            groups.append([f])
    return tuple(float(np.mean(g)) for g in groups)


def highest_mode(tests: Sequence[LevelTest]) -> float:
    """Frequency of the highest mode of any configuration, Hz."""
    return max(float(t.modes(0).frequency_hz[-1]) for t in tests)


def soft_and_hard(
    tests: Sequence[LevelTest],
) -> tuple[Mapping[str, MeasuredModes], Mapping[str, MeasuredModes]]:
    """Modes of every configuration at its softest and at its hardest level."""
    return {t.configuration: t.modes(0) for t in tests}, {t.configuration: t.modes(-1) for t in tests}
