"""Fit models to a particular sensor: its camera, its tip, and few-shot adaptation."""
