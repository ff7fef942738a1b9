"""What is made from a recording after a run."""
