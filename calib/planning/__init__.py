"""What to measure with what one has, before anything is measured, and how well each delay will be known then."""
