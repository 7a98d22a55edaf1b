"""The method neumatex: relightable materials on a known mesh, from posed pictures under a known environment."""
