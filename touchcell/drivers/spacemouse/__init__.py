"""3Dconnexion SpaceMouse: jog input in six axes with a dead-man button."""
