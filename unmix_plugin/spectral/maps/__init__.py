"""Maps from reflectance: spectral indices and target detection."""
