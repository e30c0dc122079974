"""Limits above which the report warns, each with its source."""

LOW_MAC = 0.8
"""Below this a pair is named as doubtful (common practice: 0.9 good, under 0.8 to be looked at)."""

FAR_SIGMA = 3.0
"""A difference beyond this many standard uncertainties is named."""
