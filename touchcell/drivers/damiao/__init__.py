"""Arms of Damiao motors on CAN."""
