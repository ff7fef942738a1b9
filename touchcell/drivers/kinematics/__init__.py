"""Kinematics of serial arms: chains, inverse kinematics and joint limits."""
