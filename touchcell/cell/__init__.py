"""Configuration, composition, run loop, recording and the command line."""
