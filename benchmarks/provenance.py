"""Where benchmarks look for what ``cell.provenance`` tells."""

from cell.provenance import provenance

__all__ = ["provenance"]
