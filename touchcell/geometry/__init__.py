"""SE(3): poses, twists, their Jacobians, and Gaussians over poses. The lowest layer; it imports nothing of ours."""
