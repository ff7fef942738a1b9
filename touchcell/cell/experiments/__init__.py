"""Experiments of the paper (section 5), one module each; ``touchcell.cell.experiments.runner`` runs them."""
