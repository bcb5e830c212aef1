"""Pages and figures of all three packages: blocks as HTML and PDF, figures at paper widths, a palette for all eyes.

`blocks` defines pages and writes them as HTML, `pdf` as PDF, `figures` draws at the widths of a column and of a page
with text of 8 pt, `colours` has the palette. Only `figures` and `pdf` import Matplotlib.
"""
