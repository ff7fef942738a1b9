"""Where the files that ship inside the package are."""

from pathlib import Path

PACKAGE = Path(__file__).parent
CHECKOUT = PACKAGE.parent
"""The repository, where touchcell is installed from one: it also has the benchmarks that are not shipped."""
CONFIGS = PACKAGE / "configs"
MODELS = PACKAGE / "perception" / "models"
CLASSIFIERS = PACKAGE / "perception" / "features"
