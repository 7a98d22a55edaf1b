"""File formats, one module each: from arrays to a file that is whole or not there.

Writers raise a RunError where the disk is full or refuses.
"""
