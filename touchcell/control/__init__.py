"""Tactile servoing by velocity in SE(3), and the interlocks that supervise it."""
