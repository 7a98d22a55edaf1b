"""The command line: thin functions that parse arguments, call the packages and say what was written where.

All raise an `UnmixError` for what a user can mend, which `entry` makes a sentence and an exit code.
"""

import os

# Threads that wait for each other by spinning take the time slices of those they wait for as soon as anything else
# runs on the machine: on two shared cores a training step took three times as long. Read when torch loads OpenMP.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
