"""The tips that ship: parameters of the simulated sensor, fitted to real ones."""
