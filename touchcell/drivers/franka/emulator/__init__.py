"""An emulated Franka controller."""
