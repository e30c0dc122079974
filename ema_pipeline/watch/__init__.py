"""Hits judged while one strikes: every record file as soon as it is complete, and what to strike next."""
