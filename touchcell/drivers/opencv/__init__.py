"""Cameras that only OpenCV can open."""
