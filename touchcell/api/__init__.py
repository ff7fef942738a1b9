"""What ``import touchcell`` offers: devices, cells, runs and recordings in a few calls. Nothing below imports it."""
