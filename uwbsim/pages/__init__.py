"""Pages and figures about scenarios, protocols, sweeps and twins."""

from uwbsim.pages.documents import (
    COMPARISON_COLUMNS,
    FILES,
    FLEET_COLUMNS,
    TWIN_COLUMNS,
    optimum_file,
    write_comparison,
    write_optima,
    write_sweep_page,
    write_twin,
)

__all__ = [
    "COMPARISON_COLUMNS",
    "FILES",
    "FLEET_COLUMNS",
    "TWIN_COLUMNS",
    "optimum_file",
    "write_comparison",
    "write_optima",
    "write_sweep_page",
    "write_twin",
]
