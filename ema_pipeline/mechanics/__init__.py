"""Masses, springs, dampers and nonlinear elements: matrices, modes, FRFs and time responses. Knows no rig."""
