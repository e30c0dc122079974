"""FRFs to modes: pole estimation, selection, refinement, circle fits and uncertainties."""
