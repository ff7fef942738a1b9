"""Composing devices and running the control loop."""
