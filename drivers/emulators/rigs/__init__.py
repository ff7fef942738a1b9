"""One rig per driver."""
