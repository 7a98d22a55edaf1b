"""Products of a run, with their options as fields, their help as docstring, and `write`.

Writers raise a RunError where the disk is full or refuses.
"""
