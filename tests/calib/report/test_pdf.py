"""How text and tables are set on paper: what belongs together stands together."""

import io

import pytest
from pypdf import PdfReader

from uwblink.pages.blocks import Document, Heading, Table, Text
from uwblink.pages.pdf import to_pdf


def pages(*blocks):
    read = PdfReader(io.BytesIO(to_pdf(Document("A report", list(blocks)), {})))
    return [page.extract_text() for page in read.pages]


def table(rows, above=()):
    return Table(["pair", "mean"], [[f"row-{k}", "1.0"] for k in range(rows)], list(above), total=True)


# So many lines that the table ends shortly below the page, begins shortly above its end, or has room enough.
@pytest.mark.parametrize("filled", [18, 24, 44])
@pytest.mark.parametrize("told", [[], [Text("What the table shows.")]])
def test_a_table_is_not_parted_and_stands_below_its_heading(filled, told):
    lines = [Text(f"A line of text, the {k}th.") for k in range(filled)]
    text = pages(*lines, Heading("Before"), *told, table(16, [("", 1), ("raw", 1)]))
    ends = [k for k, one in enumerate(text) if "row-0 " in one or "row-15" in one]
    assert len(ends) == 1, "all rows stand on one page"
    # Documents of one section have no contents.
    assert sum(one.count("Before") for one in text) == 1
    if not told:
        assert "Before" in text[ends[0]]


def test_a_long_table_goes_on_from_where_it_stands():
    first, *others = pages(Text("A line of text."), Heading("Before"), table(120))
    assert "row-0 " in first
    assert len(others) == 2
    assert all("pair" in page for page in others), "headings come again"
