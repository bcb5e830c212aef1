"""Every dependency names the lowest version that will do, which `make lowest` installs."""

import pytest

from tests.bounds import lowest, requirements


def test_every_requirement_has_a_lowest_version():
    listed = [lowest(row) for row in requirements()]
    assert any(row.startswith("duckdb==") for row in listed)
    assert len({row.split("==")[0] for row in listed}) == len(listed)


@pytest.mark.parametrize("row", ["numpy", "numpy>2", "numpy>=2,<3", "numpy==2.1"])
def test_one_without_is_named(row):
    with pytest.raises(ValueError, match="names no lowest version"):
        lowest(row)
