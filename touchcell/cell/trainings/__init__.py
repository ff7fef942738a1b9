"""Many trainings of estimators, kinds by data sets by seeds, on an executor."""
