"""Differentiable rendering operators, each a Warp kernel and a PyTorch twin that defines it."""
