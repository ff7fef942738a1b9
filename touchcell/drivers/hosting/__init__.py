"""Devices in processes of their own, and the watchdog chain; see docs/explanation/safety-processes.md."""
