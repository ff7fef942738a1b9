"""Templates of the packages that ``touchcell new`` writes."""
