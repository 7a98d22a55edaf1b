"""What a material is likely to be, from pictures of it: the guess that a fit starts from and returns to.

A prior takes posed views of an object under a known environment and gives a filled `Triplane`, whose networks stay as
they are while its planes are fitted: `small.predict` is the shipped one, `wan.WanPrior` has the published one's shape.
"""
