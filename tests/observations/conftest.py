"""The rig of two bodies as a fixture."""

from two_bodies import rig

__all__ = ["rig"]
