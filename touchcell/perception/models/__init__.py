"""Model files: what they hold and how they are read. The models that ship lie beside the code."""
