"""Fitted parameters, the comparison of model and measurement, and channels that contradict the model."""
