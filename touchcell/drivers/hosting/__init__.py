"""Devices in processes of their own, and who watches whom; see docs/explanation/safety-processes.md."""
