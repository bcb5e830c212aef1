"""What a recording cannot tell of the world it was made in, said in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from uwbsim.twins.flight import Flight
from uwbsim.twins.scenario_tables import LEAST_DB, Fitted, shortest_interval_s

ALWAYS: Final = (
    "How fast true time runs: rates of clocks are about their mean at the start (skew_ppm), which no range depends on.",
    "White and flicker noise of clocks (white_ppm_sqrt_s, flicker_ppm: none): in a flight they look like noise of "
    "stamps and like a walk of the rate.",
    "Noise of transmissions (tx_noise_ps: none): it is in that of receptions.",
    "How a delay splits into transmission and reception: 0.44 to 0.56.",
    "What a reflection does to total power and to impulse responses (total_loss_db, rise_ns).",
    "The shape of detours: exponential (excess_shape).",
    "Which of antenna, transmitter and receiver makes a tag's powers weak: what differs between the two directions is "
    "put on one of transmitter and receiver (the median tag has no difference), and the rest on the antenna.",
    "Powers that were never heard: sensitivity_dbm is the default or just below the weakest reading; capture_db and "
    "dynamic_range_db have their defaults.",
    "Errors of poses: those recorded are taken for true, so what they add is in direct_std_m.",
    "Walls, obstacles and shadows of bodies: what they do is in antennas, fading and reflections of pairs, and stays "
    "when bodies take other ways.",
)

RATIO_BIAS_PPM: Final = 0.02
Untold = Callable[[Flight, Fitted], bool]
SOMETIMES: Final[tuple[tuple[Untold, str], ...]] = (
    (
        lambda flight, fitted: not len(fitted.noise.std_s),
        "Noise of stamps apart from that of ranges: only a third message from the target shows it. All noise of ranges "
        "is taken to last as long as a path (direct_std_m).",
    ),
    (
        lambda flight, fitted: abs(fitted.clocks.ratio_bias_ppm) > RATIO_BIAS_PPM,
        "Why dt64/dt53 is off by {ratio_bias:+.2g} ppm against the carrier readings: nothing in a scenario makes that.",
    ),
    (
        lambda flight, fitted: fitted.reflections.life_s is None and fitted.reflections.share > 0,
        "How long reflections last (life_s): a pair ranges again after {interval:.2g} s, and by then nothing is left "
        "that is seen.",
    ),
    (
        lambda flight, fitted: fitted.reflections.share > 0 and fitted.reflections.share_std == 0,
        "Whether pairs have different shares of reflections: they differ no more than by chance, and have the same.",
    ),
    (
        lambda flight, fitted: fitted.powers.exponent is None,
        "The path-loss exponent: all distances are much the same.",
    ),
    (
        lambda flight, fitted: fitted.powers.fading_db >= LEAST_DB and fitted.powers.fading_life_s is None,
        "How long fading lasts (radio.fading.life_s): a pair ranges again after {interval:.2g} s.",
    ),
    (
        lambda flight, fitted: fitted.powers.reflection_loss_db is None,
        "How much weaker reflections are: there are too few.",
    ),
    (
        lambda flight, fitted: fitted.powers.pattern_db.shape[1] == 1,
        "Antennas of tags by direction: each has too few readings.",
    ),
    (
        lambda flight, fitted: fitted.schedule.lost_share == 0,
        "How many exchanges fail: the recording has no failed ones and no gaps in a round robin.",
    ),
)


def unknowns(flight: Flight, fitted: Fitted) -> Iterator[str]:
    """Yield a sentence for everything that keeps its default, or was decided without the recording."""
    interval = shortest_interval_s(flight)
    for untold, text in SOMETIMES:
        if untold(flight, fitted):
            yield text.format(interval=interval, ratio_bias=fitted.clocks.ratio_bias_ppm)
    yield from ALWAYS
