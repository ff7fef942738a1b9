"""Tactile perception: from an image to a Gaussian over contact pose and shear, with a Bayesian filter on SE(3)."""
