"""From a tactile image to a Gaussian over contact pose and shear, and its Bayesian filter on SE(3)."""
