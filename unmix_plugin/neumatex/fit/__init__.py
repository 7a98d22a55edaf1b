"""From a folder of pictures to fitted materials: reading, the model and where it begins, figures, the result."""
