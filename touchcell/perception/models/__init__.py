"""Model files: their contents and how they are read. The shipped models are in this folder."""
