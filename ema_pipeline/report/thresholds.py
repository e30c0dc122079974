"""Limits above which the report warns, each with its source."""

from ema_pipeline.diagnose.settings import ERROR_LIMIT

LOW_MAC = 0.8
"""Below this a pair is named as doubtful (common practice: 0.9 good, under 0.8 to be looked at)."""

FAR_SIGMA = 3.0
"""A difference beyond this many standard uncertainties is named."""

POOR_ERROR = ERROR_LIMIT
"""Error above which a model does not explain the data and its fitted values are provisional: that of the diagnosis."""
