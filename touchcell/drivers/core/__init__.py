"""What every driver builds on: lifecycle, lease, gate, stamped samples and expiring commands. It knows no device."""
