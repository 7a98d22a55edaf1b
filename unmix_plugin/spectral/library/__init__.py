"""Tables and libraries of measured spectra."""
