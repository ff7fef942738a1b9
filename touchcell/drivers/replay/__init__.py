"""Labelled data sets on disk, and devices that replay them."""
