"""Pages and figures of all three packages.

`blocks` defines pages and writes them as HTML, `pdf` writes them as PDF, `figures` draws at the widths of a column and
of a page with text of 8 pt, `colours` has a palette that is also distinct for colour-blind readers. Only `figures` and
`pdf` import Matplotlib.
"""
