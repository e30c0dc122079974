"""Tables, figures, pages and terminal output of a run."""
