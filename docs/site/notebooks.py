"""Runs the notebooks and stores them with what they print and draw: `python -m docs.site.notebooks`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

NOTEBOOKS: Final = Path(__file__).parents[1] / "notebooks"
LONGEST_S: Final = 120


def run(path: Path) -> None:
    """Run a notebook from its own folder, as readers do, and write it with its outputs."""
    import nbformat
    from nbclient import NotebookClient

    notebook: Any = nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]
    NotebookClient(notebook, timeout=LONGEST_S, resources={"metadata": {"path": str(path.parent)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # when it ran says nothing
    notebook.metadata["language_info"] = {"name": "python"}
    nbformat.write(notebook, path)  # type: ignore[no-untyped-call]


def main() -> None:
    """Run them all."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        run(path)
        sys.stdout.write(f"{path.name}: {path.stat().st_size / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()
