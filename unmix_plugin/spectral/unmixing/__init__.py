"""Linear unmixing: endmembers, abundances and their number."""
