"""Pictures of what boards report."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from uwblink.output import write_bytes
from uwblink.wire.messages import Cir


def plot_cir(cir: Cir, path: Path, *, force: bool = False) -> None:
    """Draw a channel impulse response around its first path, and write it in the format of the file's suffix.

    Raises what `uwblink.output.whole` raises.
    """
    from matplotlib.figure import Figure

    first = cir.first_path_milli / 1000
    low, high = max(int(first) - 20, 0), min(int(first) + 80, cir.TAPS)
    tap_ns = 1e3 / (2 * 499.2)  # half a chip of 499.2 MHz (firmware wire format, 4)
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([(k - first) * tap_ns for k in range(low, high)], cir.magnitudes[low:high], color="#0072B2", lw=1.6)
    axes.axvline(0, color="#D55E00", lw=1.2, label=f"first path, index {first:.3f}")
    axes.set_xlabel("time after the first path (ns)")
    axes.set_ylabel("magnitude")
    axes.set_title(f"{cir.initiator} ranging with {cir.target}", loc="left", fontsize="medium")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    drawn = BytesIO()
    figure.savefig(drawn, format=path.suffix.removeprefix(".").lower(), dpi=150)
    write_bytes(path, drawn.getvalue(), force=force)
