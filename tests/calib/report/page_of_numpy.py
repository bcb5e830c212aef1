"""Expected numbers of reports, evaluations and exports, by NumPy and SciPy from exported tables, without the packages.

It follows docs/theory.md and the reference of the keys of a calibration, as an independent check.
"""

import json
import re
from html import unescape

import numpy as np
import pandas
from scipy.interpolate import BSpline
from scipy.optimize import brentq
from scipy.stats import chi2, exponnorm, norm

LIGHT, TICK_S = 299_702_547.0, 1 / (128 * 499.2e6)
STAGES = ("raw", "delays", "full")


class Tables:
    """Tables of a page: rows of the texts of their cells."""

    def __init__(self, page):
        rows = [table.split("<tr")[1:] for table in re.findall("<table.*?</table>", page, re.DOTALL)]
        cells = re.compile("<t[dh][^>]*>(.*?)</t[dh]>")
        self.tables = [[[unescape(cell).strip() for cell in cells.findall(row)] for row in table] for table in rows]

    def having(self, *cells):
        """Return the one table whose rows contain all of some cells."""
        (found,) = (t for t in self.tables if all(any(cell in row for row in t) for cell in cells))
        return found

    def row(self, *cells):
        """Return the row that starts with the first of some cells, of the table that has them all."""
        return next(row for row in self.having(*cells) if row[:1] == [cells[0]])


def number(text):
    """Return the number at the start of a cell."""
    return float(text.split()[0].replace("−", "-").rstrip("%,;"))


def columns(path):
    """Return an exported table as columns."""
    return {name: column.to_numpy() for name, column in pandas.read_csv(path).items()}


def curve(table, lifted):
    spline = BSpline(np.array(table["knots"]), np.array(table["coefficients"]), table["degree"])
    return spline(np.clip(lifted, *table["range"]))


def beyond(table, lifted):
    """Return the linear extrapolation of a curve beyond its range, with the slopes of a tenth of the range."""
    low, high = table["range"]
    step = 0.1 * (high - low)
    a, b, c, d = curve(table, np.array([low, low + step, high - step, high]))
    up, down = np.maximum(lifted - high, 0), np.maximum(low - lifted, 0)
    return abs(b - a) / step * down + abs(d - c) / step * up


class Corrected:
    """Double-sided exchanges in a file, corrected by the file of a calibration, and their expected errors."""

    def __init__(self, table, calibration):
        e, known = columns(table), json.loads(calibration.read_text())
        rows = np.isfinite(e["truth_m"])
        e = {name: column[rows] for name, column in e.items()}
        self.first, self.second, self.truth = e["initiator"], e["target"], e["truth_m"]

        def since(later, earlier):
            return ((e[later] - e[earlier]) % 2**32).astype(float)

        k = since("rx3", "rx2") / since("tx3", "tx2")
        self.raw = LIGHT * TICK_S / 2 * (since("rx2", "tx1") - k * since("tx2", "rx1"))
        delay = {int(tag): ns * 1e-9 for tag, ns in known["delays_ns"].items()}
        d_i, d_j = (np.array([delay[t] for t in ids.tolist()]) for ids in (self.first, self.second))
        self.delays = self.raw + LIGHT / 2 * (d_i + k * d_j)
        self.lifted = np.mean([10 ** ((e[p] - known["alpha_dbm"]) / 10) for p in ("fpp1_dbm", "fpp2_dbm")], axis=0)
        bias = known["bias_curve"]
        self.full = self.delays - curve(bias, self.lifted)
        self.sigma = curve(known["sigma_curve"], self.lifted)
        self.clamped = (self.lifted < bias["range"][0]) | (self.lifted > bias["range"][1])
        self.beyond = beyond(bias, self.lifted)
        self._errors(known["errors"])

    def _errors(self, model):
        nodes, p_out, least = np.array(model["lifted"]), model["outlier_share"], model["least_m"]
        self.pair = np.array([f"{a}-{b}" for a, b in np.sort([self.first, self.second], axis=0).T.tolist()])
        self.mean_error, self.total, self.tail_share, self.low95, self.high95 = np.zeros((5, len(self.pair)))
        own = np.interp([0.025, 0.975], *np.array([[0.0, 0.0], *model["levels"], [1.0, 1.0]]).T)
        odds = np.log(np.array(model["tail_share"]) / (1 - np.array(model["tail_share"])))
        for name in np.unique(self.pair):
            rows = self.pair == name
            factor = model["pairs"].get(name, {"noise": 1.0, "odds": 1.0, "detour": 1.0})
            detour = model["detour_m"] * factor["detour"]
            first = detour / (1 - model["long_share"] + model["long_share"] * model["long_factor"])
            kinds = (1 - model["long_share"], first), (model["long_share"], model["long_factor"] * first)

            def parts(lifted, factor=factor):
                noise = np.exp(np.interp(lifted, nodes, np.log(model["noise_m"]))) * factor["noise"]
                return noise, 1 / (1 + np.exp(-np.interp(lifted, nodes, odds)) / factor["odds"])

            def below(x, lifted, kinds=kinds, parts=parts):
                noise, share = parts(lifted)
                x = x - model["location_m"]
                reflected = sum(part * exponnorm.cdf(x, m / noise, loc=least, scale=noise) for part, m in kinds)
                inside = (1 - share) * norm.cdf(x / noise) + share * reflected
                return (1 - p_out) * inside + p_out * norm.cdf(x / model["outlier_m"])

            noise, share = parts(self.lifted[rows])
            mean = (1 - p_out) * share * (least + detour)
            second = (1 - p_out) * (noise**2 + share * sum(part * (m**2 + (least + m) ** 2) for part, m in kinds))
            second += p_out * model["outlier_m"] ** 2
            self.mean_error[rows] = mean + model["location_m"]
            total = model["scale"] * np.sqrt(second - mean**2)
            wide = np.hypot(total, self.beyond[rows])
            self.total[rows], self.tail_share[rows] = wide, share
            for level, found in zip(own, (self.low95, self.high95), strict=True):
                at = [brentq(lambda x, n=n: below(x, n) - level, -80.0, 80.0) for n in nodes]  # noqa: B023
                found[rows] = np.interp(self.lifted[rows], nodes, at) * (wide / total)

    def groups(self):
        """Rows of each pair, and of all."""
        found = {str(name): self.pair == name for name in np.unique(self.pair)}
        return found | {"all": np.ones(len(self.pair), dtype=bool)}

    def of(self, rows):
        """Return the evaluation of some rows, by the keys of its JSON."""
        error = {name: (getattr(self, name) - self.truth)[rows] for name in STAGES}
        z2 = (error["full"] / self.sigma[rows]) ** 2
        raw_variance = np.mean((self.raw - self.truth - np.mean(self.raw - self.truth)) ** 2)
        standard = (error["full"] - self.mean_error[rows]) / self.total[rows]
        threshold = chi2.ppf(0.95, 1)
        inside = (error["full"] > self.low95[rows]) & (error["full"] < self.high95[rows])
        return {
            **{name: stats(error[name]) for name in STAGES},
            "rejected_raw": np.mean(error["raw"] ** 2 > threshold * raw_variance),
            "rejected": np.mean(z2 > threshold),
            "accepted": stats(error["full"][z2 <= threshold]),
            "coverage": {
                str(p): np.mean(z2 <= (1.0 if p == 68 else chi2.ppf(p / 100, 1))) for p in (50, 68, 90, 95, 99)
            },
            "clamped": np.mean(self.clamped[rows]),
            "total_mean": np.mean(standard),
            "total_std": np.std(standard),
            "inside_95": np.mean(inside),
            "tail_share": np.mean(self.tail_share[rows]),
        }


def stats(error):
    middle = np.median(error)
    return {
        "n": len(error),
        "mean_m": error.sum() / len(error),
        "median_m": middle,
        "std_m": np.sqrt(np.mean((error - error.mean()) ** 2)),
        "robust_std_m": np.median(np.abs(error - middle)) / norm.ppf(0.75),
        "low_m": np.percentile(error, 2.5),
        "high_m": np.percentile(error, 97.5),
        "abs95_m": np.percentile(np.abs(error), 95),
    }
