"""A discrete-event simulator of tags that range with ultra-wideband radios."""
