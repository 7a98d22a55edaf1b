"""Light that surfaces reflect: a differentiable path tracer."""
