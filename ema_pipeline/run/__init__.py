"""A run: its description and settings, its model, and what was measured."""
