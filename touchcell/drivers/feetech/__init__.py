"""Arms of Feetech bus servos."""
