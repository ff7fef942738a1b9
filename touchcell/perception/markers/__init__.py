"""TacTip markers: detection, matching, tracking, and contact estimation from them."""
