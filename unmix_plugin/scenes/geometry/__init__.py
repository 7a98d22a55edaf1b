"""Where a scene lies: bounds, visual hull."""
