"""Hits judged during the test: every record file as soon as it is complete, and what to strike next."""
