"""Triangle meshes: reading them, and rays against them."""
