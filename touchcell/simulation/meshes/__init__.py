"""Triangle meshes as surfaces to touch: reading, checking, smoothing, nearest points."""
