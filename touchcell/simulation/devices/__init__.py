"""Simulated arms and TacTip cameras."""
