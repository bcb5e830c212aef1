"""Pages and figures about scenarios and protocols."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.pages.comparison_page import COLUMNS, FILES, write_comparison
    from uwbsim.pages.optimum_pictures import optimum_file, write_optima
    from uwbsim.pages.sweep_page import write_sweep_page
    from uwbsim.pages.twin_page import TWIN_COLUMNS, write_twin

__all__ = [
    "COLUMNS",
    "FILES",
    "TWIN_COLUMNS",
    "optimum_file",
    "write_comparison",
    "write_optima",
    "write_sweep_page",
    "write_twin",
]

_HOMES: Final = {
    "COLUMNS": "uwbsim.pages.comparison_page",
    "FILES": "uwbsim.pages.comparison_page",
    "TWIN_COLUMNS": "uwbsim.pages.twin_page",
    "optimum_file": "uwbsim.pages.optimum_pictures",
    "write_comparison": "uwbsim.pages.comparison_page",
    "write_optima": "uwbsim.pages.optimum_pictures",
    "write_sweep_page": "uwbsim.pages.sweep_page",
    "write_twin": "uwbsim.pages.twin_page",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
