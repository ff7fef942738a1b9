"""Tasks as state machines over abilities: what the cell does, without knowing which devices do it."""
