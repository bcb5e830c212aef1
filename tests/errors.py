"""Patterns of error messages."""

import re


def one_line(*fragments: str) -> str:
    """Return the pattern of a text of one line with all fragments, for `match` of `pytest.raises`."""
    return r"\A" + "".join(f"(?=.*{re.escape(fragment)})" for fragment in fragments) + r".*\Z"
