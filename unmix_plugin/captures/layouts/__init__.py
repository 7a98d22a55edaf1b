"""Layouts of data sets: one file each, from a folder to a `Capture`."""
