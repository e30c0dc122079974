"""Hits to frequency response functions with coherence, variance and verdicts."""

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet

__all__ = ["FrfSet", "FrfSettings", "estimate_frfs"]
