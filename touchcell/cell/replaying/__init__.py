"""Replay of a run: what was recorded goes through today's perception, control and interlocks."""
