"""How the delays of a fit depend on the scale of the loss."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calib.calibration.model import Calibration
from calib.figures import label

SIZE: Final = (8.0, 3.4)


def scale_sensitivity(scales_ns: list[float], fits: list[Calibration], chosen_ns: float) -> Figure:
    """How far each delay moves, about the mean of all, as the scale of the loss changes."""
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.subplots()
    tags = sorted(fits[0].delays_ns)
    table = np.array([[fit.delays_ns[tag] for tag in tags] for fit in fits])
    table -= table.mean(axis=1, keepdims=True)
    reference = table[int(np.argmin(np.abs(np.log(np.array(scales_ns) / chosen_ns))))]
    for k, tag in enumerate(tags):
        axes.plot(scales_ns, 1e3 * (table[:, k] - reference[k]), "o-", ms=3.5, lw=1.3, label=f"tag {tag}")
    axes.axvline(chosen_ns, color="0.5", ls="--", lw=1)
    axes.text(
        chosen_ns, 0.98, " chosen", transform=axes.get_xaxis_transform(), va="top", fontsize="small", color="0.35"
    )
    axes.set_xscale("log")
    axes.set_xticks(scales_ns, [f"{scale:.3g}" for scale in scales_ns])
    axes.set_xticks([], minor=True)
    label(axes, "scale of the loss (ns of flight)", "change of the delay (ps)")
    axes.legend(frameon=False, fontsize="small", ncols=2)
    return figure
