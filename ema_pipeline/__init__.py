"""From hammer hits to the physics that the model is missing."""

__version__ = "0.1.0"
