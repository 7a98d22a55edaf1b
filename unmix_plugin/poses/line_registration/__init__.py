"""Poses of line cameras, fitted row by row to what a scene shows."""
