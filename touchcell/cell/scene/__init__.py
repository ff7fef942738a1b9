"""What a cell looks like in three dimensions: one description for recordings, viewers, pictures and pages."""
