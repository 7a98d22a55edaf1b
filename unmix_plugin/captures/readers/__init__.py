"""One file a format, each giving a `Cube` that is opened without being read."""
