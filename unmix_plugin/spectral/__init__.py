"""Pure spectral maths on tensors: bands last, wavelengths in nm. Knows no scene and no model.

Importing this package costs torch and numpy; scipy, scikit-image and colour-science are imported by the functions that
need them.
"""
