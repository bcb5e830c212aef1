"""Names the fault in a recording."""
