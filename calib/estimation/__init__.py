"""Parts of the former fit that fits without known distances still use."""
