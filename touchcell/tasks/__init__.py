"""Tasks: state machines over device protocols, independent of the devices that a cell uses."""
