"""Effects: physics that a base model may be missing. A module here with an ``EFFECT`` is in the library."""
