"""Guarded motions as data: a task written as a list of steps, in a cell file or in Python."""
