"""Analysis of a run's recording: reports, plots and viewers."""
