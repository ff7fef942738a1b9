"""The commands of ``touchcell``, a module for each group. Each adds its parsers and imports the rest when it runs."""
