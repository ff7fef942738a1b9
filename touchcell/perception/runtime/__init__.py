"""What runs in a cell: from a camera frame to a filtered estimate. It imports no training code."""
