"""ATI Net F/T force-torque sensors over Raw Data Transfer (UDP)."""
