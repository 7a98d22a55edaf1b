"""From a scene folder to a validated scene."""
