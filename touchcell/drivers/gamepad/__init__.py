"""Gamepads by the Linux input subsystem: jog input with a dead-man trigger."""
