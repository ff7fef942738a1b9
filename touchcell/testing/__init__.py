"""Tools for testing drivers and cells: emulators, the conformance suite and pytest plugins."""
