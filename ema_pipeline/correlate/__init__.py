"""Measured modes, and their pairing with the modes of a model."""
