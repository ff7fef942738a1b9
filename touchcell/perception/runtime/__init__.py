"""Perception at run time: from a camera frame to a filtered estimate. It imports no training code."""
