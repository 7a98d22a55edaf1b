"""File formats, one module each: from arrays to a file that is whole or not there."""
