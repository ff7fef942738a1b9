"""An emulated Video4Linux2 camera."""
