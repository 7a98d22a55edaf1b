"""How light meets a mesh: geometry, light from far away, reflectances, and paths between them."""
