"""Universal Robots e-Series arms."""
