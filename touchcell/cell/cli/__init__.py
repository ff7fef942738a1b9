"""The ``touchcell`` command line."""
