"""Reports as HTML and PDF, and their figures."""
