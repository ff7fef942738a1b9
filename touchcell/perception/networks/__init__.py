"""Training and evaluating estimators. Needs the extra ``train`` (PyTorch)."""
