"""Lists what is in a recording, and writes a first mapping of it."""

from __future__ import annotations

import contextlib
import fnmatch
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from harness import _harness

from . import hdf5, matlab, numpy, parquet, ros2, tables, zarr
from .arrays import Arrays
from .mapping import KNOWN, NAME, UNITS, MappingError, StreamSettings, Text, header_hint
from .recording import duration
from .streams import NO_TIME, blaming, natural
from .video import VIDEOS, Folder, Video

SETPOINT = re.compile(r"set_?point|command|cmd|action|target|desired|goal", re.IGNORECASE)
"""What the names of setpoints often contain."""
TIME = re.compile(
    r"(.*[_/ ])?(t|time|times|timestamps?|stamps?|seconds|secs?|datetime|date)([_ ]*[(\[]?(s|ms|us|ns)[)\]]?)?",
    re.IGNORECASE,
)
"""What times are often called."""
UNIT = re.compile(r"[_ ]*[(\[]([^()\[\]\d][^()\[\]]*)[)\]]\s*$")
"""The unit at the end of a column's name, as in `Force [N]`."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
"""What a number looks like in a text."""
PLAIN = re.compile(r"(\.{1,2}/)*[A-Za-z_/][A-Za-z0-9_/.-]*")
"""Texts that need no quotes in a mapping, besides words such as `true`."""
TABLES = (".csv", ".txt", ".tsv", ".gz")
"""What the names of tables end in."""
MISSING_WORDS = 5
"""More different words among the numbers of a table are no marks of missing values."""
SKIPPED_TOPICS = ("/rosout", "/parameter_events", "/tf", "/tf_static", "/events/write_split")


@dataclass
class Found:
    """A stream, or a column, that a first mapping contains."""

    name: str
    """A name for it."""
    settings: str
    """The keys of the stream in the mapping; empty for formats without streams."""
    columns: list[tuple[str, str, bool]] = field(default_factory=list)
    """Names for its modalities, what each is from, and whether it is an image."""
    rate_hz: float | None = None
    """The stream's rate."""
    gap_s: float = 0.0
    """The stream's longest gap."""
    units: dict[str, str] = field(default_factory=dict)
    """The units of its modalities, where the header says them."""


@dataclass
class Contents:
    """What is in a recording."""

    format: str
    """The format in a mapping."""
    lines: list[str]
    """A description of it."""
    found: list[Found]
    """What a first mapping contains."""
    keys: list[str] = field(default_factory=list)
    """Further lines of the mapping."""


def inspect(path: Path) -> Contents:
    """Returns what is in a file or folder.

    Raises:
        FileNotFoundError: it is not there.
        MappingError: it holds nothing that can be imported, or is damaged.
        ImportError: the package that reads it is not installed.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there")
    readers: tuple[tuple[bool, Callable[[Path], Contents]], ...] = (
        ((path / "meta/info.json").exists(), _lerobot),
        (_some(path, ros2.SUFFIXES, ("metadata.yaml", "*.db3", "*.mcap", "*/metadata.yaml")), _ros2),
        (_some(path, (".zarr",), zarr.MARKS) or path.name.endswith(".zarr.zip"), _arrays(zarr)),
        *((_some(path, each.SUFFIXES), _arrays(each)) for each in (hdf5, matlab, numpy)),
        (_some(path, (".parquet",), ("**/*.parquet",)), _parquet),
        (_some(path, TABLES, ("*/*.csv",)), _csv),
    )
    for matches, read in readers:
        if matches:
            return read(path)
    raise MappingError(
        f"{path}: holds no recording: no .csv, .h5, .zarr, .mat, .npz, .mcap, .db3, .bag or .parquet file, and no "
        "LeRobot dataset"
    )


def first_mapping(contents: Contents, source: Path, folder: Path) -> str:
    """Returns the text of a mapping in a folder. It marks what is guessed, and what the user has to fill in."""
    relative = source.relative_to(folder) if source.is_relative_to(folder) else source.resolve()
    name = re.sub(r"[^a-z0-9_]+", "_", source.stem.lower()).strip("_") or "recording"
    lines = [f"name: {name if NAME.fullmatch(name) else f'recording_{name}'[:60]}", f"source: {quoted(str(relative))}"]
    lines += [f"format: {contents.format}", *contents.keys]
    if any(each.settings for each in contents.found):
        rates = [each.rate_hz for each in contents.found if each.rate_hz]
        gap = max([each.gap_s for each in contents.found] or [0.0])
        rate = min([10.0, *rates])
        lines += [
            f"sample_rate_hz: {rate:.3g}      # samples per second of the dataset",
            f"max_gap_s: {max(0.1, float(f'{3 * gap:.1g}')):g}      # three times the longest gap of the streams",
            "gaps: refuse      # or split: a gap begins a new episode",
            "align: last      # or linear, or mean: of the values since the last sample",
            "# max_episode_s: 60      # cut a long recording into episodes",
            "streams:",
        ]
        lines += [f"  {each.name}: {{{each.settings}}}" for each in contents.found]
    lines.append("modalities:")
    modalities = [column for each in contents.found for column in each.columns]
    setpoint = next((each for each in modalities if SETPOINT.search(each[0]) and not each[2]), None)
    if setpoint:
        lines.append(f"  setpoint: {setpoint[1]}      # a guess: what the robot was commanded")
    else:
        lines.append("  setpoint: none      # a guess: nothing was commanded; or one of the lines below")
    units = {name: unit for each in contents.found for name, unit in each.units.items()}
    taken = {*_harness.reserved_names(), *KNOWN}
    has_vision = False
    for wish, term, is_image in modalities:
        if (wish, term, is_image) == setpoint:
            continue
        if is_image and not has_vision:
            has_vision = True
            lines.append(f"  vision: {term}")
            continue
        name = _free(wish, taken)
        rest = f"size: {KNOWN['vision']['size']}" if is_image else f"unit: {json.dumps(units.get(wish, ''))}"
        lines.append(f"  {name}: {{from: {term}, {rest}}}")
    return "\n".join(lines) + "\n"


def quoted(text: str) -> str:
    """Returns a text as a mapping has it: in quotes, if it would mean something else without them."""
    is_plain = PLAIN.fullmatch(text) and text.lower() not in ("true", "false", "null")
    return text if is_plain else json.dumps(text, ensure_ascii=False)


def _free(wish: str, taken: set[str]) -> str:
    """Returns a name for a modality that no other has."""
    name = re.sub(r"[^a-z0-9]+", "_", wish.lower()).strip("_")[:48] or "value"
    name = name if name[0].isalpha() else f"value_{name}"
    numbered = (f"{name}_{number}" for number in range(2, 10**6))
    while name in taken:
        name = next(numbered)
    taken.add(name)
    return name


def _some(path: Path, suffixes: tuple[str, ...], marks: tuple[str, ...] = ()) -> bool:
    if path.suffix in suffixes:
        return True
    return path.is_dir() and any(any(path.glob(mark)) for mark in (*marks, *(f"*{suffix}" for suffix in suffixes)))


def _first(path: Path, suffixes: tuple[str, ...], marks: tuple[str, ...] = ()) -> Path:
    """Returns the first recording in a folder, or the path itself."""
    if path.suffix in suffixes or path.is_file() or any((path / mark).exists() for mark in marks):
        return path
    inside = [each for each in path.iterdir() if each.suffix in suffixes or any(any(each.glob(mark)) for mark in marks)]
    return min(inside, key=natural)


# --- arrays ---


def _arrays(reader: Any) -> Callable[[Path], Contents]:
    """Returns what inspects the files of a reader of named arrays."""

    def read(path: Path) -> Contents:
        first = _first(path, reader.SUFFIXES, getattr(reader, "MARKS", ()))
        with reader.opened(first) as arrays:
            return _of_arrays(reader.__name__.rpartition(".")[2], first, arrays)

    return read


def _of_arrays(format: str, path: Path, arrays: Arrays) -> Contents:
    lines = [f"{path}:"] + [f"  {name}  {list(array.shape)}  {array.dtype}" for name, array in arrays.items()]
    keys, prefix = [], ""
    ends = next((name for name in arrays if re.search(r"(^|/)episode_ends$", name)), None)
    groups = list(dict.fromkeys(match[0] for name in arrays if (match := re.match(r"(.*/)?[^/]*?\d+(?=/)", name))))
    if ends:
        keys.append(f"episode_ends: {quoted(ends)}")
    elif len(groups) > 1:
        pattern = re.sub(r"\d+$", "*", groups[0])
        keys.append(f"episodes: {quoted(pattern)}")
        prefix = f"{groups[0]}/"
    inside = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
    times = {name: array for name, array in inside.items() if _is_time(name, array)}
    found: list[Found] = []
    taken: set[str] = set()
    for name, array in inside.items():
        is_numeric = np.dtype(array.dtype).kind in "iufb"
        if name in times or name == ends or not array.shape or not (is_numeric or np.dtype(array.dtype).kind == "O"):
            continue
        is_image = not is_numeric or (np.dtype(array.dtype) == np.uint8 and len(array.shape) >= 3)
        time = _time_of(name, array, times)
        stream = _free(name if len(name.split("/")) < 3 else "/".join(name.split("/")[-2:]), taken)
        each = Found(stream, "", [(stream, stream, is_image)])
        if time:
            values = np.asarray(times[time][:]).reshape(-1)
            unit = _unit(values)
            each.rate_hz, each.gap_s = _rate(values.astype(np.float64) * UNITS[unit] / 1e9)
            each.settings = f"data: {quoted(name)}, time: {quoted(time)}" + (
                f", time_unit: {unit}" if unit != "s" else ""
            )
        else:
            each.settings = f"data: {quoted(name)}, rate_hz: "
        found.append(each)
    if any(each.settings.endswith("rate_hz: ") for each in found):
        keys.append("# fill in rate_hz: no times were found for some arrays")
    return Contents(format, lines, found, keys)


def _is_time(name: str, array: Any) -> bool:
    is_vector = array.shape and max(array.shape) == np.prod(array.shape)
    return bool(is_vector and np.dtype(array.dtype).kind in "iuf" and TIME.fullmatch(name.split("/")[-1]))


def _time_of(name: str, array: Any, times: Arrays) -> str | None:
    """Returns the times of an array: those in its own group, or the only ones of its length."""
    same = [time for time, values in times.items() if np.prod(values.shape) in (array.shape[0], array.shape[-1])]
    own = [time for time in same if time.rpartition("/")[0] == name.rpartition("/")[0]]
    return own[0] if own else same[0] if len(same) == 1 else None


def _unit(values: np.ndarray) -> str:
    """Returns the likely unit of times since 1970, from their size; s for all others."""
    largest = float(np.nanmax(np.abs(values.astype(np.float64)))) if len(values) else 0.0
    return "ns" if largest > 1e17 else "us" if largest > 1e14 else "ms" if largest > 1e11 else "s"


def _rate(times_s: np.ndarray) -> tuple[float | None, float]:
    """Returns the rate of times and their longest gap, s."""
    periods = np.diff(times_s)
    periods = periods[np.isfinite(periods) & (periods > 0)]
    return (1 / float(np.median(periods)), float(periods.max())) if len(periods) else (None, 0.0)


# --- bags ---


def _ros2(path: Path) -> Contents:
    first = _first(path, ros2.SUFFIXES, ("metadata.yaml", "*.db3", "*.mcap"))
    lines = [f"{first}:"]
    found: list[Found] = []
    taken: set[str] = set()
    with ros2.opened(first) as bag:
        topics = sorted({each.topic: each for each in bag.connections}.items())
        for topic, connection in topics:
            received = np.array([time for time, _ in bag.raw(connection)], np.float64) / 1e9
            rate, gap = _rate(received)
            speed = f"{rate:.4g} Hz, longest gap {duration(gap)}" if rate else "no rate"
            lines.append(f"  {topic}  {connection.msgtype}  {len(received)} messages, {speed}")
            message = next((message for _, message in bag.messages(connection)), None)
            if message is None or topic in SKIPPED_TOPICS:
                continue
            groups = _joints(bag, connection) if connection.msgtype == ros2.JOINT_STATE else {}
            for messages in groups.values():
                lines.append(f"    {len(messages)} messages of the joints {', '.join(messages[0][1].name)}")
            if len(groups) > 1:
                found += [_of_joints(_free(topic, taken), topic, *group) for group in groups.items()]
                continue
            stream = _free(topic, taken)
            each = Found(stream, f"topic: {quoted(topic)}", rate_hz=rate, gap_s=gap)
            if connection.msgtype in (ros2.IMAGE, ros2.COMPRESSED):
                each.columns = [(stream, stream, True)]
            else:
                for column, width in _columns(message):
                    lines.append(f"    {column}  {width} values")
                    term = stream if column == "data" and len(_columns(message)) == 1 else f"{stream}.{column}"
                    each.columns.append((f"{stream}_{column}" if term != stream else stream, term, False))
            if each.columns:
                found.append(each)
    return Contents("ros2", lines, found)


def _joints(bag: ros2.Bag, connection: Any) -> dict[frozenset[str], list[tuple[int, Any]]]:
    """Returns the messages of a topic of joints, each with when it was received, by the joints that they have."""
    groups: dict[frozenset[str], list[tuple[int, Any]]] = {}
    for time, message in bag.messages(connection):
        groups.setdefault(frozenset(message.name), []).append((time, message))
    return groups


def _of_joints(stream: str, topic: str, joints: frozenset[str], messages: list[tuple[int, Any]]) -> Found:
    """Returns a stream of the messages that have some joints."""
    rate, gap = _rate(np.array([time for time, _ in messages], np.float64) / 1e9)
    first = messages[0][1]
    columns = []
    for field in ros2.OF_EACH_JOINT:
        if len(getattr(first, field)) == len(joints):
            term = _list(stream, [f"{field}.{joint}" for joint in first.name])
            columns.append((f"{stream}_{field}", term, False))
    return Found(stream, f"topic: {topic}, missing: skip", columns, rate, gap)


def _columns(message: Any) -> list[tuple[str, int]]:
    """Returns the fields of a message that belong together, such as `position` or `wrench.force`, and their widths."""
    available = ros2.fields(message)
    leaves = [name for name in available if not any(other.startswith(f"{name}.") for other in available)]
    widths = {}
    for leaf in leaves:
        parent = leaf.rpartition(".")[0]
        chosen = parent if parent in available else leaf
        value = message
        for part in chosen.split("."):
            value = getattr(value, part)
        numbers = ros2.flattened(value)
        if numbers is not None and len(numbers):
            widths[chosen] = len(numbers)
    return list(widths.items())


# --- tables ---


def _csv(path: Path) -> Contents:
    lines = [f"{path}:"]
    found: list[Found] = []
    taken: set[str] = set()
    clocks: dict[str, str] = {}
    for pattern, file in _files(path):
        stream = _free("log" if pattern.startswith("*.") else file.stem, taken)
        key = f"file: {quoted(pattern)}, " if pattern else ""
        if file.is_dir():
            images = Folder(stream, file)
            lines.append(f"  {pattern}: {images.count} images, such as {images.files[0].name}")
            found.append(Found(stream, f"{key}rate_hz: ", [(stream, stream, True)]))
        elif file.suffix.lower() in VIDEOS:
            video = Video(stream, file)
            rate, gap = _rate(video.times / 1e9)
            lines.append(f"  {pattern}: video, {video.count} frames, {rate or 0:.4g} Hz")
            found.append(Found(stream, key.rstrip(", "), [(stream, stream, True)], rate, gap))
        else:
            table, units, cleaning = _cleaned(file)
            key += cleaning
            parts = _of_table(stream, key, table, units, pattern or str(file), lines, taken)
            found += [part for part in parts if part.columns]
            if not any(part.columns for part in parts) and parts[0].rate_hz:
                # A file of times alone has those of the frames that are called like it.
                clocks[file.stem] = parts[0].settings.replace("file:", "times:")
    for each in found:
        stem = each.columns[0][0].removesuffix("_2")
        if each.columns[0][2] and stem in clocks:
            each.settings = f"{each.settings.removesuffix(', rate_hz: ')}, {clocks[stem]}"
    files = {each.settings.split(",")[0] for each in found}
    return Contents("csv", lines, found, _trial(path) if len(files) == 1 else [])


def _trial(path: Path) -> list[str]:
    """Returns the key `trial` of files that are called by what they show and a number."""
    names = [] if path.is_file() else [each.stem for each in path.iterdir() if each.suffix.lower() in TABLES]
    parts = [re.fullmatch(r"(.*[^\d_ -])([_ -])(\d+)", name) for name in names]
    shown = {part[1] for part in parts if part}
    separators = {part[2] for part in parts if part}
    if len(names) < 2 or len(shown) < 2 or not all(parts) or len(separators) > 1:
        return []
    pattern = f"{{object}}{separators.pop()}{{number:int}}"
    return [f"trial: {quoted(pattern)}      # a guess: labels of the episodes, from the names of the files"]


def _files(path: Path) -> Iterator[tuple[str, Path]]:
    """Yields the files of the first episode, each with the pattern of all episodes."""
    if path.is_file():
        yield "", path
        return
    videos = (*TABLES, *VIDEOS)
    own = sorted((each for each in path.iterdir() if each.suffix.lower() in videos), key=natural)
    inner = sorted((each for each in path.iterdir() if each.is_dir() and any(each.glob("*.csv"))), key=natural)
    if inner:
        for each in sorted(inner[0].iterdir(), key=natural):
            if each.suffix.lower() in videos or each.is_dir():
                yield f"*/{each.name}", each
        return
    # Files with the same columns are episodes of one stream. Others are streams of one episode.
    alike: dict[Any, list[Path]] = {}
    for each in own:
        alike.setdefault(_kind(each), []).append(each)
    several = len(alike) > 1
    for files in alike.values():
        if len(files) == 1 and several:
            yield files[0].name, files[0]
            continue
        names = [each.name for each in files]
        before, after = os.path.commonprefix(names), os.path.commonprefix([name[::-1] for name in names])[::-1]
        # The number of an episode may begin or end like those of others.
        before, after = re.sub(r"\d+$", "", before), re.sub(r"^\d+", "", after)
        pattern = f"{before}*{after}" if several else f"*{files[0].suffix}"
        yield (files[0].name if len(own) == 1 else pattern), files[0]


def _kind(path: Path) -> Any:
    """Returns what files of one stream have in common: the columns of tables, or the ending and the name of others."""
    if path.suffix.lower() in TABLES:
        with contextlib.suppress(MappingError, OSError):
            return tables.header(path)[1]
    return path.suffix.lower(), re.sub(r"\d+", "*", path.stem)


def _cleaned(file: Path) -> tuple[tables.Table, dict[str, str], str]:
    """Returns a table without its units and missing values, the units, and the keys of its stream for both."""
    names = re.split(r"[,;\s]+", tables.header(file)[1].strip())
    header = "none" if header_hint(names) else ""
    table = tables.Table(file, Text(header))
    units = _units(table)
    table = tables.Table(file, Text(header, has_units=True)) if units else table
    words: set[str] = set()
    lacks_some = False
    for name in table.names:
        texts = table.column(name)
        if texts.dtype == pl.String:
            others = texts.filter(texts.cast(pl.Float64, strict=False).is_null() & texts.is_not_null())
            is_numeric = len(others) + texts.null_count() < len(texts) / 2
            words |= {*others.unique().to_list()} if is_numeric else set()
            lacks_some |= is_numeric and len(others) + texts.null_count() > 0
    words -= {*tables.BOOLEANS}
    if len(words) > MISSING_WORDS:
        words = set()
    keys = "header: none, " * bool(header) + "units_row: true, " * bool(units) + "missing: skip, " * lacks_some
    keys += f"missing_values: {json.dumps(sorted(words), ensure_ascii=False)}, " if words else ""
    return tables.Table(file, Text(header, bool(units), missing=tuple(words))), units, keys


def _units(table: tables.Table) -> dict[str, str]:
    """Returns the units of columns, if the line below the header has some: no number, above numbers."""
    rows = {name: table.column(name, 0, 2).cast(pl.String).to_list() for name in table.names}
    numbers = [[value is not None and bool(NUMBER.fullmatch(value)) for value in values] for values in rows.values()]
    if any(each[0] for each in numbers) or not any(each[-1] for each in numbers):
        return {}
    return {name: values[0] or "" for name, values in rows.items()}


def _of_table(
    stream: str, key: str, table: tables.Table, units: dict[str, str], place: str, lines: list[str], taken: set[str]
) -> list[Found]:
    """Returns a stream of a file, or one for each column of times, with the columns that begin like it."""
    lines.append(f"  {place}: {table.rows} rows")
    times = [name for name in table.names if TIME.fullmatch(name)]
    prefixes = {name: re.split(r"[^_/ -]*$", name)[0] for name in times}
    clocks = [name for name in times if sum(other.startswith(prefixes[name]) for other in table.names) > 1]
    if len(times) > 1 and all(prefixes.values()) and len(set(prefixes.values())) == len(times):
        own = {name: [each for each in table.names if each.startswith(prefixes[name])] for name in clocks}
        streams = [_free(prefixes[name], taken) for name in clocks]
        both = zip(streams, clocks, strict=True)
        return [_of_columns(stream, key, table, units, own[name], name, lines) for stream, name in both]
    names = [name for name in table.names if name not in times[1:]]
    return [_of_columns(stream, key, table, units, names, times[0] if times else None, lines)]


def _of_columns(
    stream: str,
    key: str,
    table: tables.Table,
    units: dict[str, str],
    columns: list[str],
    time: str | None,
    lines: list[str],
) -> Found:
    """Returns a stream of some columns of a table."""
    each = Found(stream, f"{key}rate_hz: ")
    if time:
        with_unit = re.search(r"[_ (\[](ms|us|ns)[)\]]?$", time)
        try:
            told = units.get(time, "")
            unit = told if told in UNITS else with_unit[1] if with_unit else _unit(table.numbers(time))
        except MappingError:
            unit = "s"
        times = table.times([time], StreamSettings(stream, time_unit=UNITS[unit], skip_missing=True))
        each.rate_hz, each.gap_s = _rate(times[times != NO_TIME] / 1e9)
        each.settings = f"{key}time: {quoted(time)}" + (f", time_unit: {unit}" if unit != "s" else "")
    groups: dict[str, list[str]] = {}
    for name in columns:
        texts = table.column(name)
        numbers = texts.cast(pl.Float64, strict=False)
        is_numeric = numbers.null_count() < len(numbers)
        shown = ", ".join(str(value) for value in texts.head(3).to_list())
        lines.append(f"    {name}  {'numbers' if is_numeric else 'text'}: {shown}, …")
        if is_numeric and name != time:
            groups.setdefault(re.sub(r"([_ ]?\d+|\[\d+\])$", "", name) or name, []).append(name)
    for base, names in groups.items():
        patterns = [f"{base}*", f"{base}?", f"{base}_?", f"{base}_*"]
        fitting = [each for each in patterns if fnmatch.filter(table.names, each) == names and "[" not in each]
        single = quoted(f"{stream}.{names[0]}")
        term = single if len(names) == 1 else quoted(f"{stream}.{fitting[0]}") if fitting else _list(stream, names)
        unit = UNIT.search(base)
        name = base.removesuffix(unit[0]) if unit else base
        each.columns.append((f"{stream}_{name}", term, False))
        each.units[f"{stream}_{name}"] = unit[1] if unit else units.get(names[0], "")
    return each


def _list(stream: str, names: list[str]) -> str:
    return f"[{', '.join(quoted(f'{stream}.{name}') for name in names)}]"


def _parquet(path: Path) -> Contents:
    files = [path] if path.is_file() else sorted(path.glob("**/*.parquet"))
    with blaming(str(files[0])):
        schema = parquet.scanned(files[:1]).collect_schema()
    lines = [f"{files[0]}:"] + [f"  {name}  {kind}" for name, kind in schema.items()]
    episode = next((name for name in schema if re.search(r"episode|trial|run", name, re.IGNORECASE)), "")
    rows = re.compile(r"^(sample|frame|index|row|step)|time|stamp")
    order = next((name for name in schema if rows.search(name) and name != episode), "")
    keys = [
        f"episode: {quoted(episode) if episode else ''}      # the column whose value differs between episodes",
        f"order: {quoted(order) if order else ''}      # the column by which an episode's rows are sorted",
        "sample_rate_hz: 10      # fill in: samples per second",
    ]
    columns = [
        (name, quoted(name), kind in (pl.Binary, pl.Struct))
        for name, kind in schema.items()
        if name not in (episode, order) and (kind.is_numeric() or kind in (pl.List, pl.Array, pl.Binary, pl.Struct))
    ]
    return Contents("parquet", lines, [Found(name, "", [(name, term, image)]) for name, term, image in columns], keys)


def _lerobot(path: Path) -> Contents:
    with blaming(str(path / "meta/info.json")):
        info = json.loads((path / "meta/info.json").read_text(encoding="utf-8"))
        features = {name: (list(each["shape"]), each["dtype"]) for name, each in info["features"].items()}
    lines = [
        f"{path}: {info.get('total_episodes')} episodes of {info.get('total_frames')} samples, {info.get('fps')} Hz"
    ]
    lines += [f"  {name}  {shape}  {kind}" for name, (shape, kind) in features.items()]
    own = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    found = [
        Found(name, "", [(name.removeprefix("observation."), quoted(name), kind in ("video", "image"))])
        for name, (_, kind) in features.items()
        if name not in own and kind != "string"
    ]
    return Contents("lerobot", lines, found)
