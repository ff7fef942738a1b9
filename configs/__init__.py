"""Cell files that ship with touchcell."""
