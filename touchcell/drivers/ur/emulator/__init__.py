"""An emulated UR controller."""
