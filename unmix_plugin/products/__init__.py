"""Products of a run: one file each, with its options as fields, its help as docstring, and `write`."""
