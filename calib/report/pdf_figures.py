"""Put figures onto the pages of a PDF as drawings, so that their text stays text."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from pypdf import PageObject

MM_OF_INCH: Final = 25.4


class Place(NamedTuple):
    """Where a figure is to stand: page from 0, left and bottom edge in mm."""

    name: str
    page: int
    left_mm: float
    bottom_mm: float


def page_of(pdf: bytes) -> PageObject:
    """Return the one page of a figure's PDF."""
    from pypdf import PdfReader

    return PdfReader(io.BytesIO(pdf)).pages[0]


def size_mm(page: PageObject) -> tuple[float, float]:
    """Return width and height of a figure."""
    return float(page.mediabox.width) / 72 * MM_OF_INCH, float(page.mediabox.height) / 72 * MM_OF_INCH


def with_figures(text: bytes, pictures: Mapping[str, PageObject], places: Sequence[Place]) -> bytes:
    """Return the PDF `text` with figures at their places: as forms, so that they stay drawings with text."""
    from pypdf import PdfReader, PdfWriter
    from pypdf.generic import DictionaryObject, NameObject

    writer = PdfWriter(clone_from=PdfReader(io.BytesIO(text)))
    drawn: dict[int, list[tuple[str, float, float]]] = {}
    for number, place in enumerate(places):
        resources: Any = writer.pages[place.page]["/Resources"].get_object()
        held = resources.setdefault(NameObject("/XObject"), DictionaryObject()).get_object()
        held[NameObject(f"/Fig{number}")] = writer._add_object(_form(pictures[place.name], writer))
        drawn.setdefault(place.page, []).append((f"Fig{number}", place.left_mm, place.bottom_mm))
    for page, some in drawn.items():
        _append(writer.pages[page], some)
    writer.compress_identical_objects()  # each figure brings the same fonts
    data = io.BytesIO()
    writer.write(data)
    return data.getvalue()


def _form(source: PageObject, writer: Any) -> Any:
    """Return a page as a form: what can be drawn on another page."""
    from pypdf.generic import NameObject, StreamObject

    form = StreamObject()
    form.set_data(source.get_contents().get_data())  # type: ignore[union-attr]  # a figure has contents
    form.update(
        {
            NameObject("/Type"): NameObject("/XObject"),
            NameObject("/Subtype"): NameObject("/Form"),
            NameObject("/BBox"): source.mediabox,
            NameObject("/Resources"): source["/Resources"].clone(writer),
        }
    )
    if "/Group" in source:
        form[NameObject("/Group")] = source["/Group"].clone(writer)
    return form.flate_encode()


def _append(page: Any, figures: list[tuple[str, float, float]]) -> None:
    """Draw forms on a page, at left and bottom edges in mm, after what is there."""
    from pypdf.generic import NameObject, StreamObject

    point = 72 / MM_OF_INCH
    words = "".join(f"q 1 0 0 1 {x * point:.3f} {y * point:.3f} cm /{name} Do Q\n" for name, x, y in figures)
    stream = StreamObject()
    # fpdf2 leaves a page with the scale and colours that it had; what it saved is restored first.
    stream.set_data(b"q\n" + page.get_contents().get_data() + b"\nQ\n" + words.encode())
    page[NameObject("/Contents")] = page.indirect_reference.pdf._add_object(stream.flate_encode())
