"""Poses of other programs, read or estimated, as a `PoseSet`."""
