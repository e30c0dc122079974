"""The verbs of the command ``ema``: each parses its words, calls one function, and shows what came of it."""
