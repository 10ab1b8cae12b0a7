"""The page of an import: plots of every modality, and of the times of every stream, in one HTML file."""

from __future__ import annotations

import base64
import html
import io
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from harness.recorded import Episode

from .alignment import Quality
from .mapping import Mapping
from .recording import Recording, duration

WIDTH, HEIGHT = 400, 150
"""Size of a plot, pixels."""
MARGIN = (46, 8, 8, 20)
"""Left, top, right and bottom margin of a plot, pixels."""
POINTS = 300
"""The most columns of a plot. Longer series are drawn as the range of each column."""
FRAMES = 8
"""How many images of an episode are shown."""
COLORS = ("#1f6fb4", "#d1601f", "#2f8f3a", "#a33a9b", "#8a6d1c", "#16908f", "#c23b50", "#5b5bc7")
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1320px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin: 1.6em 0 .3em; border-top: 1px solid #ddd; padding-top: .8em; }
table { border-collapse: collapse; } th, td { text-align: right; padding: .1em .8em .1em 0; }
th:first-child, td:first-child, td.text { text-align: left; } th { font-weight: 600; }
figure { display: inline-block; margin: 0 8px 8px 0; vertical-align: top; }
figcaption, .note { color: #666; font-size: 13px; } img { image-rendering: pixelated; margin-right: 2px; }
.warning { color: #a02020; } svg text { font: 11px system-ui, sans-serif; fill: #666; }
.key { display: inline-block; width: 12px; height: 3px; vertical-align: middle; margin-right: 4px; }
"""


@dataclass
class Sketch:
    """What the page shows of the episodes: all of three, and the range of all."""

    shown: list[int]
    """The episodes that are shown."""
    episodes: list[Episode] = field(default_factory=list)
    """Those, with a few images each."""
    image_samples: list[np.ndarray] = field(default_factory=list)
    """Which samples these images are, for each of them."""
    lengths: list[int] = field(default_factory=list)
    """The samples of each episode."""
    places: list[str] = field(default_factory=list)
    """Where each episode is in the recording."""
    ranges: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)
    """The least, the largest and the sum of each element of each vector."""

    @classmethod
    def of(cls, recording: Recording) -> Sketch:
        """Returns a sketch without episodes, of which the first, the middle and the last will be shown."""
        return cls(sorted({0, recording.length // 2, max(recording.length - 1, 0)}))

    def add(self, episode: Episode, place: str) -> None:
        """Adds the next episode, and where it is in the recording."""
        self.lengths.append(len(episode))
        self.places.append(place)
        for name, values in episode.vectors.items():
            low, high, total = values.min(axis=0), values.max(axis=0), values.sum(axis=0, dtype=np.float64)
            known = self.ranges.get(name)
            if known is not None and len(known[0]) == len(low):
                low, high, total = np.minimum(low, known[0]), np.maximum(high, known[1]), total + known[2]
            self.ranges[name] = (low, high, total)
        if episode.index in self.shown:
            samples = np.unique(np.linspace(0, len(episode) - 1, FRAMES).round().astype(int))
            images = {name: frames[samples] for name, frames in episode.images.items()}
            self.episodes.append(Episode(episode.index, episode.time, episode.vectors, images))
            self.image_samples.append(samples)


def write_page(path: Path, name: str, mapping: Mapping, recording: Recording, sketch: Sketch, notes: list[str]) -> None:
    """Writes the page of an imported dataset. The notes are what may be wrong with it.

    Raises:
        OSError: the file can't be written.
    """
    samples, least, most = sum(sketch.lengths), min(sketch.lengths), max(sketch.lengths)
    parts = [
        f"<h1>Import of {html.escape(name)}</h1>",
        f"<p>{len(sketch.lengths)} episodes, {samples} samples at {recording.sample_rate_hz:g} Hz "
        f"({duration(samples / recording.sample_rate_hz)}), from {html.escape(str(mapping.source))}. Each episode has "
        f"{least if least == most else f'{least} to {most}'} samples.</p>",
    ]
    parts += [f'<p class="warning">{html.escape(note[0].upper() + note[1:])}.</p>' for note in notes]
    parts += [f'<p class="warning">{html.escape(line)}.</p>' for line in mapping.counts.lines]
    if recording.qualities:
        parts += _streams(recording.qualities)
    for modality, selection in mapping.selections.items():
        source = " + ".join(selection.terms)
        parts.append(f"<h2>{modality} <span class='note'>from {html.escape(source)}</span></h2>")
        parts += _images(modality, sketch) if selection.size else _vector(modality, selection.unit, sketch)
    parts += [
        f"<h2>{modality} <span class='note'>from the label {each.label}</span></h2>"
        for modality, each in mapping.labeled.items()
    ]
    rows = "".join(
        f"<tr><td>{index}</td><td>{length}</td><td class='text'>{html.escape(place)}</td></tr>"
        for index, (length, place) in enumerate(zip(sketch.lengths, sketch.places, strict=True))
    )
    parts.append(f"<h2>Episodes</h2><table><tr><th>episode</th><th>samples</th><td></td></tr>{rows}</table>")
    head = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(name)}</title><style>{STYLE}</style>'
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(f"{head}<body>{''.join(parts)}</body></html>\n", encoding="utf-8")
    draft.replace(path)


def _streams(qualities: list[Quality]) -> list[str]:
    """The times of the streams."""
    rows, plots = [], []
    for each in qualities:
        if not each.rows:
            continue
        transport = "–" if each.transport_s is None else duration(each.transport_s)
        cells = [
            str(each.rows),
            f"{each.rate_hz:.4g} Hz",
            duration(each.jitter_s),
            duration(each.gap_ns / 1e9),
            duration(each.delay_s),
            transport,
        ]
        rows.append(f"<tr><td>{each.name}</td>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
        periods = np.concatenate(each.periods) / 1e6
        if len(periods):
            chart = _plot(np.arange(len(periods), dtype=float), periods[:, None], 0.0, float(periods.max()), "row")
            caption = f"{each.name}: time to the next row, ms. The longest is after {html.escape(each.gap_at)}."
            plots.append(f"<figure>{chart}<figcaption style='max-width: {WIDTH}px'>{caption}</figcaption></figure>")
    head = "".join(
        f"<th>{name}</th>" for name in ("stream", "rows", "rate", "jitter", "longest gap", "delay", "transport")
    )
    note = (
        "<p class='note'>Jitter is what 95 % of the times between rows differ at most from their median. Delay is how "
        "old the last value is at a sample, on average. Transport is the median time from a message's header to its "
        "receipt.</p>"
    )
    return ["<h2>Streams</h2>", f"<table><tr>{head}</tr>{''.join(rows)}</table>", note, *plots]


def _vector(name: str, unit: str, sketch: Sketch) -> list[str]:
    """The values of a vector over time, and their ranges."""
    low, high, total = sketch.ranges[name]
    parts = []
    for episode in sketch.episodes:
        values = episode.vectors[name]
        chart = _plot(episode.time, values, float(low.min()), float(high.max()), "s")
        parts.append(f"<figure>{chart}<figcaption>episode {episode.index}</figcaption></figure>")
    means, count = total / sum(sketch.lengths), len(low)
    constant = [str(index) for index in range(count) if low[index] == high[index]]
    if constant:
        which = "All elements" if len(constant) == count else f"The elements {', '.join(constant)}"
        parts.append(f'<p class="warning">{which} have the same value at all samples.</p>')
    shown = range(min(count, 24))
    rows = "".join(
        f"<tr><td><span class='key' style='background: {COLORS[index % len(COLORS)]}'></span>{index}</td>"
        f"<td>{low[index]:.4g}</td><td>{means[index]:.4g}</td><td>{high[index]:.4g}</td></tr>"
        for index in shown
    )
    more = (
        f"<p class='note'>{count - len(shown)} further elements are drawn, but not listed.</p>"
        if count > len(shown)
        else ""
    )
    head = f"<tr><th>element</th><th>least</th><th>mean</th><th>largest</th><td>{html.escape(unit)}</td></tr>"
    parts.append(
        f"<details><summary class='note'>values of all episodes</summary><table>{head}{rows}</table>{more}</details>"
    )
    return parts


def _images(name: str, sketch: Sketch) -> list[str]:
    """A few images of each episode that is shown."""
    parts = []
    for episode, samples in zip(sketch.episodes, sketch.image_samples, strict=True):
        pictures = "".join(
            f'<img src="data:image/png;base64,{_png(image)}" height="128" alt="sample {sample}">'
            for image, sample in zip(episode.images[name], samples.tolist(), strict=True)
        )
        times = ", ".join(f"{episode.time[sample]:.4g}" for sample in samples.tolist())
        parts.append(f"<figure>{pictures}<figcaption>episode {episode.index}, at {times} s</figcaption></figure>")
    return parts


def _png(image: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return base64.b64encode(buffer.getvalue()).decode()


def _plot(across: np.ndarray, values: np.ndarray, low: float, high: float, unit: str) -> str:
    """A plot of values, [points, elements], as SVG. Its range is from `low` to `high`."""
    left, top, right, bottom = MARGIN
    if high <= low:
        low, high = low - 0.5, high + 0.5
    wide, tall = WIDTH - left - right, HEIGHT - top - bottom
    span = float(across[-1] - across[0]) or 1.0
    lines = []
    for element in range(values.shape[1]):
        x, y = _reduced(across, values[:, element].astype(np.float64))
        pixels = zip(left + (x - across[0]) / span * wide, top + (high - y) / (high - low) * tall, strict=True)
        points = " ".join(f"{px:.1f},{py:.1f}" for px, py in pixels)
        color = COLORS[element % len(COLORS)]
        lines.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.2"/>')
    frame = f'<rect x="{left}" y="{top}" width="{wide}" height="{tall}" fill="#fafafa" stroke="#ccc"/>'
    labels = (
        f'<text x="{left - 4}" y="{top + 9}" text-anchor="end">{high:.3g}</text>'
        f'<text x="{left - 4}" y="{top + tall}" text-anchor="end">{low:.3g}</text>'
        f'<text x="{left}" y="{HEIGHT - 5}">{across[0]:.4g}</text>'
        f'<text x="{WIDTH - right}" y="{HEIGHT - 5}" text-anchor="end">{across[-1]:.4g} {unit}</text>'
    )
    return f'<svg width="{WIDTH}" height="{HEIGHT}">{frame}{"".join(lines)}{labels}</svg>'


def _reduced(across: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns a series of at most POINTS columns. A longer one has the range of each column."""
    if len(values) <= 2 * POINTS:
        return across, values
    starts = np.linspace(0, len(values), POINTS, endpoint=False).astype(int)
    ranges = np.stack([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
    return np.repeat(across[starts], 2), ranges.reshape(-1)
