"""One file a format, each giving a `SpectralFile` that is opened without being read."""
