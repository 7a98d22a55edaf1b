"""Cameras, rays and boxes: where things are."""
