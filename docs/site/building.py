"""What `make docs` does before Sphinx reads the pages: writes those that are generated."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

GENERATED: Final = Path(__file__).parents[1] / "generated"


def write_pages(_app: Any = None) -> None:
    """Write all generated pages into docs/generated."""


def connect(app: Any) -> dict[str, bool]:
    """Have Sphinx write the generated pages before it looks for pages."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
