"""One module per subject; each function takes results and returns a matplotlib Figure."""
