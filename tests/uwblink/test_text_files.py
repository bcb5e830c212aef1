"""Files that cannot be read as text: one line each, in the caller's error."""

import pytest

from uwblink.errors import ImportTableError
from uwblink.text_files import read_text


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("nowhere", "no such map"),
        ("folder", "is a directory, expected a map"),
        ("latin1", "not a text file in UTF-8"),
        ("nowhere\0", "no path of a map"),
        ("n" * 300, "(File name too long)"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, name, line):
    (tmp_path / "folder").mkdir()
    (tmp_path / "latin1").write_bytes("abcé".encode("latin-1"))
    with pytest.raises(ImportTableError) as found:
        read_text(str(tmp_path / name), ImportTableError, "map")
    assert line in str(found.value)
    assert "\n" not in str(found.value)
    assert "\0" not in str(found.value)


def test_text_comes_back_as_it_is(tmp_path):
    (tmp_path / "text").write_text("µ\n", encoding="utf-8")
    assert read_text(tmp_path / "text", ValueError) == "µ\n"
