"""The recording: file, tables, summary, and distances between its tags."""
