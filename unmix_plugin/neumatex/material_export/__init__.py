"""Materials of a surface as files for others: textures, a glTF approximation, and a description of the decoder."""
