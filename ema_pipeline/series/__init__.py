"""Many tests: every raw folder of a tree becomes one results folder and one row of a table, which is then judged."""
