"""An object from a run of unmix-nerf: its mesh, its light and its pictures as a folder that neumatex trains on."""
