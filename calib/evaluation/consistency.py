"""Localization summed up over bodies and recordings, and whether a filter's opinion of its errors holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.errors import UnanswerableError
from calib.evaluation.tracking import FILTERS, Localization
from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Over all bodies of all recordings: mean RMSE by filter, its reduction, mean NIS and NEES of the variance filter.

    `rmse_m` are means over seeds, too, `spread_m` standard deviations over seeds of the mean over bodies (NaN of one
    seed). `nis` is over accepted ranges, of which a gate at 99.9 % leaves 0.99; `nees` should be 3, a state's size.
    `nis_bounds` and `nees_bounds` hold 95 % of such means if the filter is consistent: chi-square over the number of
    independent values (Bar-Shalom, Li and Kirubarajan 2001, section 5.4), where a NEES counts once in the time that the
    error takes to forget. `nis_inside` and `nees_inside` are the shares of single values within their 95 % bounds.
    """

    rmse_m: dict[str, float]
    spread_m: dict[str, float]
    reduction: dict[str, float]
    nis: float
    nis_bounds: tuple[float, float]
    nis_inside: float
    nees: float
    nees_bounds: tuple[float, float]
    nees_inside: float
    accepted: float


def summarize(found: list[Localization]) -> Summary:
    """Average over bodies and recordings, each counting the same, as in the paper.

    Raises `UnanswerableError` where the filter took no range at all.
    """
    filters = [name for name in FILTERS if all(name in one.tracks for one in found)]
    means = {name: np.mean([one.rmse_m[name] for one in found], axis=0) for name in filters}
    rmse = {name: float(np.mean(over)) for name, over in means.items()}
    last = [one.tracks["variance"] for one in found]
    nis = np.concatenate([track.nis[track.accepted] for track in last])
    nees = np.concatenate([track.nees for track in last])
    if not len(nis):
        names = ", ".join(f"{one.source}: {one.body}" for one in found)
        raise UnanswerableError(f"{names}: no range agrees with the track within its gate; look at `calib doctor`")
    return Summary(
        rmse_m=rmse,
        spread_m={name: float(np.std(over, ddof=1)) if len(over) > 1 else np.nan for name, over in means.items()},
        reduction={name: 1 - rmse[name] / rmse["raw"] for name in filters[1:]},
        nis=float(np.mean(nis)),
        nis_bounds=_bounds(len(nis), 1),
        nis_inside=_inside(nis, 1),
        nees=float(np.mean(nees)),
        nees_bounds=_bounds(sum(_independent(track.nees) for track in last), 3),
        nees_inside=_inside(nees, 3),
        accepted=float(np.mean([np.mean(track.accepted) for track in last])),
    )


def _bounds(count: float, degrees: int) -> tuple[float, float]:
    """Bounds that hold the mean of `count` independent chi-squares with 95 %."""
    from scipy.special import gammaincinv

    some = max(count, 1.0)
    half = some * degrees / 2
    return float(2 * gammaincinv(half, 0.025) / some), float(2 * gammaincinv(half, 0.975) / some)


def _inside(values: Floats, degrees: int) -> float:
    from scipy.special import gammaincinv

    low, high = float(2 * gammaincinv(degrees / 2, 0.025)), float(2 * gammaincinv(degrees / 2, 0.975))
    return float(np.mean((values >= low) & (values <= high)))


def _independent(values: Floats) -> float:
    """Return how many independent values a correlated series is worth: n over the sum of its autocorrelations.

    The sum ends where the autocorrelation first falls below a twentieth.
    """
    centred = values - values.mean()
    size = 1 << int(2 * len(centred) - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size)) ** 2
    correlation = np.fft.irfft(power, size)[: len(centred)]
    correlation = correlation / max(float(correlation[0]), 1e-300)
    small = np.flatnonzero(correlation < 0.05)
    end = int(small[0]) if len(small) else len(centred)
    return len(centred) / (1 + 2 * float(correlation[1:end].sum()))
