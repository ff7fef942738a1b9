"""Finding and matching the markers of a TacTip, and estimating a contact from them."""
