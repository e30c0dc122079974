"""Frequencies that move from hit to hit: estimated in every hit, aligned before modes are identified."""
