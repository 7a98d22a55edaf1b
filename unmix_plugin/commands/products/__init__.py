"""Products of `unmix-export`, one module each: options as fields, help as docstring, and `write`."""
