"""Tasks as state machines over protocols: what the cell does, without knowing which devices do it."""
