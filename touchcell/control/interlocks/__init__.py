"""Safety rules over a snapshot of the cell."""
