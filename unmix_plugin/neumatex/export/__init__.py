"""Materials for other programs: textures, a textured mesh, the decoder as a shader."""
