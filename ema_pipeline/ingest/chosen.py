"""Hits that the user excludes, and the one good hit that every point needs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from ema_pipeline.check_result import CheckResult
from ema_pipeline.choices import HitChoice
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.records import Hit

CHOICE = "choice"
"""Name of the verdict on hits that the user excluded."""


def without_excluded(hits: tuple[Hit, ...], excluded: Collection[HitChoice]) -> tuple[Hit, ...]:
    """The hits, with a verdict that rejects those that the user excluded."""
    named = {(x.file, x.number) for x in excluded}
    verdict = CheckResult(CHOICE, 1.0, 0.0, "1", False, "", "reject_hit", message="excluded by the user")
    return tuple(
        replace(h, verdicts=(*h.verdicts, verdict)) if (h.file, h.number) in named else h for h in hits
    )


def rejected_by_choice(hit: Hit) -> bool:
    """True where nothing but the user's choice rejects a hit."""
    failed = [v for v in hit.verdicts if v.consequence == "reject_hit" and not v.passes]
    return all(v.check == CHOICE for v in failed)


def require_good_hits(hits: tuple[Hit, ...], configuration: str) -> None:
    """Make sure that one good hit per impact point is left.

    Raises
    ------
    EmaError
        Names the point without a good hit, and why its hits were rejected.
    """
    good = {h.impact.point for h in hits if h.accepted}
    for hit in hits:
        if hit.impact.point not in good:
            reasons = "; ".join(f"{h.file}: {h.reason}" for h in hits if h.impact.point == hit.impact.point)
            raise EmaError(
                f"{configuration}: no good hit on {hit.impact.point} ({reasons}); strike it again, or correct test.toml"
            )
