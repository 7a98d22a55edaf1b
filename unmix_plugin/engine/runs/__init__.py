"""Run folders: what a training leaves behind, written and read."""
