"""The command line: parse, call, say what was written where."""
