"""Simulation of surfaces, objects, contact with slip, the tip's marker field and its images."""
