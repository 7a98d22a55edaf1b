"""From files to a validated scene: transforms.json, cubes, splits, bounds, carving."""
