"""Light from far away: environment maps, read from files or built in."""
