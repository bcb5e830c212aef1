"""Settings of the documentation site; `make docs` builds it into docs/_build/html."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from docs.site.building import connect as setup  # noqa: F401 - Sphinx calls `setup`
from uwblink import __version__

project = "uwbcal"
author = "the uwbcal authors"
release = __version__
version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx_design"]
exclude_patterns = ["_build", "generated", "site", "examples", "maps", "figures"]
myst_enable_extensions = ["deflist", "colon_fence"]
myst_heading_anchors = 3
# Code fences of the pages say after the language how the tests run them; MyST takes the first word alone.
suppress_warnings = [
    "mystnb.unknown_mime_type",
    "ref.python",  # several rooms have a class of one name: annotations find theirs by its module
]

# Single backticks in docstrings are code, as everywhere else in the project.
default_role = "code"
autodoc_member_order = "alphabetical"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
maximum_signature_line_length = 88
autodoc_type_aliases = {
    name: name
    for name in (
        "ArrayLike",
        "Bools",
        "Floats",
        "Ints",
        "NDArray",
        "Axes",
        "Figure",
        "Data",
        "Source",
        "Settings",
        "Using",
    )
}
nitpicky = True
# Names of other libraries, whose documentation is elsewhere, aliases of types of arrays, and classes behind the doors.
nitpick_ignore_regex = [
    (
        "py:class",
        r"(annotated_types|duckdb|np|collections|contextlib|datetime|numpy|os|pathlib|pydantic|matplotlib|typing)\..*",
    ),
    (
        "py:class",
        r"uwbsim\.scenario\..*|FaultsFile|GeometricMultipath|ScenarioTag|Shadow|Spline|SweepSettings",
    ),  # models of files, which have pages of their own
    (
        "py:class",
        r"(Mapping|tuple)\[.*|AbstractContextManager|AntennaDelays|Draw|DuckDBPyConnection|OverheardDelay|deque|PathLike|Path|ndarray|dtype|float64|complex128|ArrayLike|Bools|Floats|Ints|NDArray|Axes|Figure|Data|Source|Using|ListPortInfo|Pair|PlacedBody|Value|World",
    ),
]

nb_execution_mode = "force"
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_merge_streams = True

copybutton_exclude = ".linenos, .gp"
highlight_language = "none"
smartquotes = False  # two dashes begin an option

html_theme = "furo"
html_title = f"uwbcal {release}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")
html_copy_source = False
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5d8f", "color-brand-content": "#0b5d8f"},
    "dark_css_variables": {"color-brand-primary": "#7cc4f0", "color-brand-content": "#7cc4f0"},
}
