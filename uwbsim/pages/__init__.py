"""Pages and figures about scenarios and protocols."""
