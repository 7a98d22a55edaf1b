"""Cameras of several lenses: the lens of each file, and poses of all lenses from those of some."""
