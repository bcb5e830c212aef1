"""How the delays of a fit depend on the scale of the loss."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from calib.calibration.model import Calibration
from calib.figures import keep_strays_out
from uwblink.pages.colours import MUTED, look
from uwblink.pages.figures import NARROW_IN, label, legend, mark, sheet


def scale_sensitivity(width_in: float, scales_ns: list[float], fits: list[Calibration], chosen_ns: float) -> Figure:
    """How far each delay moves, about the mean of all, as the scale of the loss changes."""
    figure, (axes,) = sheet(width_in, height_in=2.8)
    tags = sorted(fits[0].delays_ns)
    table = np.array([[fit.delays_ns[tag] for tag in tags] for fit in fits])
    table -= table.mean(axis=1, keepdims=True)
    reference = table[int(np.argmin(np.abs(np.log(np.array(scales_ns) / chosen_ns))))]
    moved = 1e3 * (table - reference)
    for k, tag in enumerate(tags):
        (line,) = axes.plot(scales_ns, moved[:, k], label=f"tag {tag}", **look(k).line())
        mark(line, f"tag {tag}")
    keep_strays_out(axes, moved.ravel())
    axes.axvline(chosen_ns, color=MUTED, ls="--", lw=0.8)
    axes.text(chosen_ns, 0.98, " chosen", transform=axes.get_xaxis_transform(), va="top", color=MUTED)
    axes.set_xscale("log")
    kept = scales_ns[::2] if width_in < NARROW_IN else scales_ns
    axes.set_xticks(kept, [f"{scale:.3g}" for scale in kept])
    axes.set_xticks([], minor=True)
    label(axes, "scale of the loss (ns of flight)", "change of the delay (ps)")
    legend(figure)
    return figure
