"""The one registry of outputs: what can be asked of a trained scene, in commands, Python and the viewer."""

from unmix_plugin.trained.outputs.families import OutputFamily
from unmix_plugin.trained.outputs.registry import FAMILIES, OUTPUTS, find_output, output_names

__all__ = ["FAMILIES", "OUTPUTS", "OutputFamily", "find_output", "output_names"]
