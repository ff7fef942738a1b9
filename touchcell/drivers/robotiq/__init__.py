"""Driver, codec and emulator of Robotiq 2F grippers."""
