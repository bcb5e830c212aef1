"""Pages and figures of all three packages: blocks set as HTML and PDF, figures at paper widths, colours for all eyes.

`blocks` is what a page is made of and how it is written, `html` and `pdf` set it, `figures` draws at the widths of a
column and of a page with text of 8 pt, `colours` has the palette. Only `figures` and `pdf` import Matplotlib.
"""
