"""TacTip cameras over Video4Linux2."""
