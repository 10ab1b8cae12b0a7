"""Writes runs as event files of TensorBoard with its own writer."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from harness import Exported
from harness.export import bar
from harness.export.runs import Run, by_experiment, varying

try:
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import api_pb2, plugin_data_pb2
    from tensorboard.plugins.hparams import metadata as hparams
    from tensorboard.plugins.text import metadata as text
    from tensorboard.summary.writer.event_file_writer import EventFileWriter
    from tensorboard.util.tensor_util import make_tensor_proto
except ImportError as error:
    raise ImportError(
        f"exporting to TensorBoard needs the package tensorboard: pip install tensorboard ({error})"
    ) from error

STATUS = {"done": api_pb2.STATUS_SUCCESS, "failed": api_pb2.STATUS_FAILURE, "running": api_pb2.STATUS_RUNNING}
"""TensorBoard's names of the statuses. It has none for interrupted runs."""

VERSION = "harness-version"
"""The file next to a run's events that says which version of the run was exported."""


def write(runs: list[Run], folder: str | Path, progress: bool) -> Exported:
    """Writes each run to `folder/EXPERIMENT/RUN`. Runs that were written before are skipped unless they changed.

    A run's folder appears only after all of its files are written.
    """
    folder, exported = Path(folder), 0
    folder.mkdir(parents=True, exist_ok=True)
    with bar(len(runs), "tensorboard", " runs", progress) as shown:
        for group in by_experiment(runs).values():
            differing = varying(group)
            for run in group:
                target = folder / run.experiment / run.id
                version = target / VERSION
                if not version.is_file() or version.read_text() != run.version:
                    _replace(target, run, differing, folder)
                    exported += 1
                shown.update()
    return Exported(exported, len(runs) - exported)


def _replace(target: Path, run: Run, differing: list[str], folder: Path) -> None:
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as unfinished:
        written = Path(unfinished) / "written"
        written.mkdir()
        _write(written, run, differing)
        (written / VERSION).write_text(run.version)
        target.parent.mkdir(exist_ok=True)
        if target.exists():
            target.rename(Path(unfinished) / "replaced")
        written.rename(target)


def _write(folder: Path, run: Run, differing: list[str]) -> None:
    writer = EventFileWriter(str(folder))
    try:
        settings = {key: _number_or_text(run.settings.get(key)) for key in differing}
        begin = plugin_data_pb2.SessionStartInfo(group_name=run.name, start_time_secs=run.started)
        for key, value in settings.items():
            kind = "bool" if isinstance(value, bool) else "string" if isinstance(value, str) else "number"
            setattr(begin.hparams[key], f"{kind}_value", value)
        _add(writer, run.started, 0, _session(hparams.SESSION_START_INFO_TAG, session_start_info=begin))
        for tag, content in {"spec": f"```yaml\n{run.spec}```", "tags": _table(run.tags)}.items():
            about = text.create_summary_metadata(display_name="", description="")
            tensor = make_tensor_proto(content.encode())
            _add(writer, run.started, 0, Summary.Value(tag=tag, metadata=about, tensor=tensor))
        points = run.curves
        for point in points:
            _add(writer, point.time, point.epoch, Summary.Value(tag=point.name, simple_value=point.value))
        last = max((point.epoch for point in points), default=0)
        for name, value in run.metrics().items():
            _add(writer, run.ended, last, Summary.Value(tag=name, simple_value=value))
        status = STATUS.get(run.row["status"], api_pb2.STATUS_UNKNOWN)
        end = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=run.ended)
        _add(writer, run.ended, last, _session(hparams.SESSION_END_INFO_TAG, session_end_info=end))
    finally:
        writer.close()


def _add(writer: EventFileWriter, time: float, step: int, value: Summary.Value) -> None:
    writer.add_event(Event(wall_time=time, step=step, summary=Summary(value=[value])))


def _session(tag: str, **data: Any) -> Summary.Value:
    about = hparams.create_summary_metadata(plugin_data_pb2.HParamsPluginData(**data))
    return Summary.Value(tag=tag, metadata=about, tensor=hparams.NULL_TENSOR)


def _number_or_text(value: Any) -> bool | float | str:
    if isinstance(value, list):
        return ", ".join(str(item) for item in value)
    return value if isinstance(value, (bool, int, float, str)) else str(value)


def _table(tags: dict[str, str]) -> str:
    """A table in Markdown."""
    rows = (f"| {name} | {value.replace('|', chr(92) + '|')} |" for name, value in tags.items())
    return "\n".join(["| tag | value |", "|---|---|", *rows])
