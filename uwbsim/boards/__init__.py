"""Virtual boards on virtual or pseudo-terminal ports."""
