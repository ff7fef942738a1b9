"""What a tip touches: nothing, a surface, an edge or a corner, with probabilities."""
