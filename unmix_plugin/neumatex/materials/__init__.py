"""Families of materials: reflectances that share a set of parameters."""
