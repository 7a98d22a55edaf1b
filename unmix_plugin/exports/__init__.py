"""From a run to files: what is measured of it, and what others can use of it. Files are whole or not there."""
