"""A trained scene: what renders, probes and evaluates it."""
