"""Recording of a run: MCAP files and data sets."""
