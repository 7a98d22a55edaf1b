"""Several processes that train one model: how they start, find each other and keep their models equal."""
