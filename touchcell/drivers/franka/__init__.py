"""Franka arms."""
