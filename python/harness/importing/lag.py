"""The delay between two streams of a recording, by cross-correlation."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .labels import TRIAL, number
from .mapping import Mapping, MappingError, Sampling, Selection
from .recording import Takes, aligned, duration
from .streams import Take, needing

WINDOWS = 8
"""In how many parts a trial is divided for the interval and the drift, if it is long enough."""
LEAST_CORRELATION = 0.5
"""Parts with a weaker correlation say nothing of the delay."""


@dataclass(frozen=True)
class Lag:
    """By how much the second of two columns comes after the first in a trial."""

    trial: str
    """The label of the trial."""
    delay_s: float
    """The delay, s."""
    half_s: float
    """Half of its 95 % interval, s; NaN for trials with less than three parts."""
    drift: float
    """By how much it grows, s per s."""
    drift_half: float
    """Half of the 95 % interval of the drift, s per s."""
    correlation: float
    """Pearson's correlation at this delay."""
    offset_s: float
    """What `offset_s` of the second stream must be, so that the delay becomes 0, s."""


def lags(path: Path, terms: tuple[str, str], longest_s: float) -> list[Lag]:
    """Returns the delay between two columns in each trial of a mapping's recording.

    Args:
        path: the mapping.
        terms: the columns, such as `joints.angle` and `force.z[2]`.
        longest_s: the longest delay that is looked for, s.

    Raises:
        MappingError: a column is not there, or the delay can't be found in a trial.
    """
    mapping = Mapping.load(path)
    sampling = mapping.sampling
    if sampling is None:
        raise MappingError(f"{path}: only streams have times of their own; the rows of this format are samples")
    selections = {name: Selection(name, (term,), None) for name, term in zip(("A", "B"), terms, strict=True)}
    mapping = dataclasses.replace(mapping, selections=selections)
    found = []
    for take in _takes(mapping, sampling):
        series = []
        for term, selection in zip(terms, selections.values(), strict=True):
            (column, *others) = selection.columns(take.columns)
            stream = take.streams[column.partition(".")[0]]
            values = selection.pick({each: stream.read(each, 0, len(stream)) for each in [column, *others]})
            if values.shape[1] != 1:
                raise MappingError(f"--lag: {term} has {values.shape[1]} values; name one, such as {term}[0]")
            series.append((stream.times / 1e9, values[:, 0].astype(np.float64)))
        name = terms[1].partition(".")[0]
        before = number(f"streams.{name}.offset_s", sampling.streams[name].offset_s, take.labels)
        found.append(_lag(str(take.labels[TRIAL]), series[0], series[1], longest_s, before))
    return found


def _takes(mapping: Mapping, sampling: Sampling) -> Iterator[Take]:
    """Yields the takes of a recording, of which only the two columns are read."""
    try:
        yield from Takes(mapping, sampling)
    except MappingError as error:
        raise MappingError(re.sub(r"modalities\.[AB]: ", "--lag: ", str(error))) from None


Series = tuple[np.ndarray, np.ndarray]
"""Times, s, and values."""


def _lag(trial: str, first: Series, second: Series, longest_s: float, before_s: float) -> Lag:
    """Returns the delay of a trial. `before_s` is the offset that the second stream has already."""
    with needing("scipy", "the delay between streams"):
        from scipy.stats import linregress, t
    step = min(float(np.median(np.diff(times))) for times, _ in (first, second))
    begin, end = max(first[0][0], second[0][0]), min(first[0][-1], second[0][-1])
    grid = np.arange(begin, end, step)
    a, b = (np.interp(grid, *each) for each in (first, second))
    most = int(np.ceil(longest_s / step))
    inner = len(grid) - 2 * most
    if inner < 2 * most:
        raise MappingError(
            f"trial {trial}: both streams are there for {max(end - begin, 0):.3g} s, which is too short to look for "
            f"delays of up to {longest_s:g} s; name a shorter one with --max-lag"
        )
    delay, correlation = _peak(a, b, most)
    if abs(delay) >= most or correlation < LEAST_CORRELATION:
        raise MappingError(
            f"trial {trial}: no delay of up to {longest_s:g} s fits: the strongest correlation is {correlation:.2f}, "
            f"at {duration(delay * step)}; name a longer one with --max-lag, or columns that tell more of each other"
        )
    count = min(WINDOWS, inner // (2 * most))
    bounds = np.linspace(0, inner, count + 1).astype(int)
    parts = [
        (step * (start + stop + 2 * most) / 2, *_peak(a[start : stop + 2 * most], b[start : stop + 2 * most], most))
        for start, stop in zip(bounds[:-1], bounds[1:], strict=True)
    ]
    at, delays, weights = np.array(parts).T
    sure = (weights >= LEAST_CORRELATION) & (np.abs(delays) < most)
    at, delays = at[sure], delays[sure] * step
    half = drift = drift_half = float("nan")
    if len(delays) >= 3:
        half = float(t.ppf(0.975, len(delays) - 1) * delays.std(ddof=1) / np.sqrt(len(delays)))
        line = linregress(at, delays)
        drift, drift_half = float(line.slope), float(t.ppf(0.975, len(delays) - 2) * line.stderr)
    return Lag(trial, delay * step, half, drift, drift_half, correlation, before_s - delay * step)


def _peak(a: np.ndarray, b: np.ndarray, most: int) -> tuple[float, float]:
    """Returns the delay at which b resembles a most, samples, and the absolute correlation there."""
    from scipy.signal import correlate, detrend

    # A trend resembles itself at any delay.
    plain = (a, b)
    a, b = detrend(a), detrend(b)
    if any(each.std() <= 1e-9 * np.abs(whole).max() for each, whole in zip((a, b), plain, strict=True)):
        return 0.0, 0.0
    inner = a[most : len(a) - most] - a[most : len(a) - most].mean()
    length = len(inner)
    sums, squares = (np.cumsum(np.append(0.0, each)) for each in (b - b.mean(), (b - b.mean()) ** 2))
    energy = (squares[length:] - squares[:-length]) - (sums[length:] - sums[:-length]) ** 2 / length
    norm = np.sqrt(np.maximum(energy, 0.0) * (inner**2).sum())
    products = np.abs(correlate(b - b.mean(), inner, mode="valid"))
    found = np.divide(products, norm, out=np.zeros_like(products), where=norm > 1e-6 * norm.max())
    best = int(found.argmax())
    if not 0 < best < len(found) - 1:
        return float(best - most), float(found[best])
    # The parabola through the peak and its neighbors.
    left, peak, right = found[best - 1 : best + 2]
    bend = left - 2 * peak + right
    return best - most + (0.5 * (left - right) / bend if bend else 0.0), float(peak)


def table(found: list[Lag], terms: tuple[str, str]) -> list[str]:
    """Returns the lines that tell the delays of all trials, and how to remove them."""
    from scipy.stats import t

    def milliseconds(time_s: float) -> str:
        return "-" if np.isnan(time_s) else f"{1e3 * time_s:.1f}"

    head = ("trial", "delay (ms)", "± (ms)", "drift (ms/min)", "± (ms/min)", "correlation")
    rows = [head] + [
        (
            each.trial,
            milliseconds(each.delay_s),
            milliseconds(each.half_s),
            milliseconds(60 * each.drift),
            milliseconds(60 * each.drift_half),
            f"{each.correlation:.3f}",
        )
        for each in found
    ]
    lines = aligned(rows)
    delays = np.array([each.delay_s for each in found])
    half = t.ppf(0.975, len(delays) - 1) * delays.std(ddof=1) / np.sqrt(len(delays)) if len(delays) > 1 else np.nan
    half = half if len(delays) > 1 else found[0].half_s
    interval = f", ± {milliseconds(half)} ms (95 % interval)" if np.isfinite(half) else ""
    lines.append(f"{terms[1]} comes {milliseconds(float(delays.mean()))} ms after {terms[0]}{interval}")
    streams = [term.partition(".")[0] for term in terms]
    if streams[0] == streams[1]:
        return lines
    offset = float(np.mean([each.offset_s for each in found]))
    return [*lines, f"to remove the delay, say 'offset_s: {offset:.4f}' in streams.{streams[1]}"]
