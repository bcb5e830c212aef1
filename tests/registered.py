"""A row of another program in a table of plug-ins, for as long as a test needs it."""

from contextlib import contextmanager


@contextmanager
def registered(table, row):
    table.register(row)
    try:
        yield row
    finally:
        table.remove(row.name)
