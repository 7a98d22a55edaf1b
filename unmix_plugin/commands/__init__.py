"""The command line: thin functions that parse arguments, call the packages and say what was written where.

All raise an `UnmixError` for what a user can mend, which `entry` makes a sentence and an exit code.
"""
