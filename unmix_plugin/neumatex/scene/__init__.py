"""An object's folder: mesh, environment and posed pictures, read and checked."""
