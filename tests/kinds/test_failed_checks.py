"""What a diagnosis tells of FRFs whose checks fail."""

from __future__ import annotations

from ema_pipeline.check_result import judged
from ema_pipeline.kinds.by_modes import _told


def test_failures_of_one_check_are_told_one_by_one_or_the_worst_of_many() -> None:
    failed = [
        judged("coherence", v, 0.9, False, "", "warn", f"coherence is {v}") for v in (0.8, 0.3, 0.7, 0.85)
    ]
    assert _told(failed[:2]) == ["coherence is 0.8", "coherence is 0.3"]
    assert _told(failed) == ["coherence is 0.3 (the worst of 4)"]
