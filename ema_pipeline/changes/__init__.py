"""Two tests: what changed from A to B, mode by mode and, with a rig, as physical effects."""
