"""What each key of a calibration's JSON is: the reference of the format."""

from __future__ import annotations

from typing import Final

from uwblink.toml import FileKey


def _curve(name: str, of: str) -> tuple[FileKey, ...]:
    return (
        FileKey(f"{name}.knots", "numbers", "needed", f"Knots of the B-spline of the {of} over lifted power."),
        FileKey(
            f"{name}.coefficients", "numbers, m", "needed", "Its coefficients, as many as knots less degree less 1."
        ),
        FileKey(f"{name}.degree", "whole number", "needed", "Degree of its pieces."),
        FileKey(f"{name}.range", "2 numbers", "needed", "Lifted powers that it was fitted on; constant beyond them."),
    )


FILE_KEYS: Final = (
    FileKey(
        "schema_version", "1 to 4", "needed", "2 with `groups`, 3 with `power_at` reception, 4 with `pair_offsets`."
    ),
    FileKey("delays_ns.TAG", "number, ns", "needed", "Aggregate antenna delay of a tag, transmit less receive."),
    FileKey("delays_std_ns.TAG", "number, ns, or null", "needed", "Its standard error; null where data leave it free."),
    FileKey("loss", "text", "needed", "What the fit minimized."),
    FileKey("scale_ns", "number, ns", "needed", "The loss's scale: beyond it a range counts less."),
    FileKey(
        "lift",
        '"mean-of-lifted" or "lift-of-mean"',
        "needed",
        "How the two powers of an exchange make its lifted power.",
    ),
    FileKey("alpha_dbm", "number, dBm", "needed", "Power whose lifted power is 1."),
    FileKey("speed_of_light", "number, m/s", "needed", "With which times were made distances."),
    *_curve("bias_curve", "bias, which corrected ranges are less by"),
    *_curve("sigma_curve", "standard deviation of corrected ranges without reflections"),
    FileKey("provenance.KEY", "anything", "needed", "Writer, recordings, counts, recipe, gauge, warnings: for people."),
    FileKey(
        "power_at",
        '"exchange" or "reception"',
        '"exchange"',
        "Where the bias curve is taken: at an exchange's lifted power, or half at each of both powers.",
    ),
    FileKey("groups.NAME.tags", "whole numbers", "no groups", "Tags of one antenna design."),
    *_curve("groups.NAME.bias_curve", "bias of these tags"),
    *_curve("groups.NAME.sigma_curve", "standard deviation of these tags"),
    FileKey("errors.lifted", "numbers, increasing", "no errors", "Lifted powers of the two next keys."),
    FileKey("errors.noise_m", "numbers, m", "needed", "Standard deviation without reflections there."),
    FileKey("errors.tail_share", "numbers, 0 to 1", "needed", "Share of ranges on reflections there."),
    FileKey("errors.least_m", "number, m", "needed", "Shortest detour of a reflection."),
    FileKey("errors.detour_m", "number, m", "needed", "Mean of what reflections travel beyond that, exponential."),
    FileKey("errors.long_share", "number, 0 to 1", "0", "Share of the reflections that are of the long kind."),
    FileKey("errors.long_factor", "number, above 0", "1", "Mean of the long detours over that of the others."),
    FileKey("errors.outlier_share", "number, 0 to 1", "needed", "Share of ranges that belong to nothing else."),
    FileKey("errors.outlier_m", "number, m", "needed", "Standard deviation of those."),
    FileKey("errors.location_m", "number, m", "needed", "Where the middle of the noise lies."),
    FileKey("errors.scale", "number", "needed", "Factor that makes the total standard deviation hold."),
    FileKey(
        "errors.levels", "pairs of numbers, 0 to 1", "needed", "Shares, and the model's levels that held for them."
    ),
    FileKey("errors.pairs.PAIR.noise", "number, above 0", "1", "Factor of a pair, as 1-2, on the noise."),
    FileKey("errors.pairs.PAIR.odds", "number, above 0", "1", "Its factor on the odds of a reflection."),
    FileKey("errors.pairs.PAIR.detour", "number, above 0", "1", "Its factor on the mean detour."),
    FileKey("pair_offsets.PAIR.offset_m", "number, m", "no constants", "How much longer ranges of a pair read."),
    FileKey("pair_offsets.PAIR.std_m", "number, m", "needed", "Its standard error."),
    *(
        FileKey(f"antenna_delays.TAG.{name}", "whole number, ticks", "not known", f"{what}, when it was recorded.")
        for name, what in (
            ("tx", "Transmit antenna delay register of a tag"),
            ("rx", "Receive antenna delay register of a tag"),
            ("reply", "What a tag's firmware added to the stamps of its delayed replies"),
        )
    ),
    FileKey("uncertainty.tags", "whole numbers", "not known", "Tags in the order of the next key."),
    FileKey("uncertainty.delays_ns2", "matrix, ns²", "needed", "Covariance of the delays."),
    FileKey("uncertainty.bias_m2", "matrix, m²", "needed", "Covariance of the bias curve's coefficients."),
    FileKey("uncertainty.sigma_m2", "matrix, m²", "needed", "Covariance of the other curve's coefficients."),
)
