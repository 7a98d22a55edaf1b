"""Built-in objects with layered materials, rendered by the path tracer."""
