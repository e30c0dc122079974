"""Up to where figures over frequency go: one rule for the page and for print."""

from __future__ import annotations

from collections.abc import Iterable

from ema_pipeline.modal.types import ModalModel

ABOVE = 2.0
"""Times the highest mode, where figures end: room for the flank of the last peak and for what may follow it. The band
of a hammer test often goes on to many times that, and all modes would be a few pixels at its lower end."""


def shown_to(end_hz: float, places_hz: Iterable[float]) -> float:
    """Frequency where a figure ends, Hz.

    Parameters
    ----------
    end_hz : float
        Where the band ends.
    places_hz : iterable of float
        What is to be seen; the whole band where nothing is.
    """
    highest = max(places_hz, default=end_hz)
    return min(end_hz, ABOVE * highest)


def places(modal: ModalModel | None) -> list[float]:
    """Frequencies of modes and of what looks like one and is left out, Hz."""
    if modal is None:
        return []
    return [m.frequency_hz for m in modal.modes] + [x.frequency_hz for x in modal.left_out]
