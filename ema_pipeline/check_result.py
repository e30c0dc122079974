"""Results of checks: what was measured, against which limit, by which clause."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Consequence = Literal["reject_hit", "reject_channel", "warn"]


@dataclass(frozen=True)
class CheckResult:
    """The outcome of one quality check.

    Attributes
    ----------
    check : str
        Short name, e.g. ``"double hit"``.
    value, limit : float
        What was measured and what it is held against, both in `unit`.
    unit : str
        Unit of `value` and `limit`; ``"1"`` for a ratio.
    passes : bool
        True where the limit is kept.
    clause : str
        Source of the limit, e.g. ``"ISO 7626-5:2019, 7.4"``; ``""`` where it is our own.
    consequence : {"reject_hit", "reject_channel", "warn"}
        What happens when the check fails: the hit is left out, one channel of the hit is left
        out, or it is only reported.
    channel : str
        Channel that it is about, ``""`` for the hit as a whole.
    message : str
        One plain sentence for the technician, e.g. ``"second impact of 12 % after 8.1 ms"``.
    """

    check: str
    value: float
    limit: float
    unit: str
    passes: bool
    clause: str
    consequence: Consequence
    channel: str = ""
    message: str = ""


def judged(
    check: str,
    value: float,
    limit: float,
    passes: bool,
    clause: str,
    consequence: Consequence,
    fault: str,
    *,
    channel: str = "",
    unit: str = "1",
) -> CheckResult:
    """Result whose message is the fault where the check fails, and empty where it passes."""
    message = "" if passes else fault
    return CheckResult(
        check, float(value), float(limit), unit, bool(passes), clause, consequence, channel, message
    )
