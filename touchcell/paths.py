"""Where the files that ship inside the package are."""

from pathlib import Path

_PACKAGE = Path(__file__).parent
CHECKOUT = _PACKAGE.parent
"""The repository, where touchcell is installed from one: it also has the benchmarks that are not shipped."""
CONFIGS = _PACKAGE / "configs"
MODELS = _PACKAGE / "perception" / "models"
