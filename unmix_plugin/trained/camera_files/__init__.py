"""Cameras as files."""
