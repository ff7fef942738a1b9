"""The paper's experiments (section 5), one module each; ``cell.experiment`` runs them."""
