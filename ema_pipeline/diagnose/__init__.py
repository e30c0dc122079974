"""Which physics a model is missing: hypotheses, ranking, claims, verdict and limits."""
