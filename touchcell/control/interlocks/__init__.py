"""Safety interlocks: rules that are checked on a snapshot of the cell."""
