"""The command `harness import`, also as `python -m harness.importing`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from harness import _harness
from harness.importing import run_import
from harness.importing.inspection import first_mapping, inspect
from harness.importing.recording import table

EXAMPLES = """examples:
  harness import mapping.yaml
  harness import --inspect recordings/trial_1.h5
  harness import --inspect bags --output lab.yaml
"""


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="harness import",
        description="Import a recording as a dataset: a LeRobot dataset, Parquet, CSV, HDF5, zarr or MATLAB files,\n"
        "or ROS 2 bags.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "mapping",
        type=Path,
        nargs="?",
        help="YAML file that says what to import, and which columns are which modality",
    )
    folder = "folder of datasets and runs [default: results]"
    parser.add_argument("--results", type=Path, metavar="DIR", help=folder)
    parser.add_argument(
        "--inspect", type=Path, metavar="FILE", help="list what is in a recording; write a first mapping"
    )
    output = "the file for the first mapping, with --inspect [default: FILE.yaml]"
    parser.add_argument("--output", type=Path, metavar="MAPPING", help=output)
    arguments = parser.parse_args(words)
    if (arguments.mapping is None) == (arguments.inspect is None):
        parser.error("name a mapping, or a recording with --inspect FILE")
    if arguments.output and not arguments.inspect:
        parser.error("--output needs --inspect FILE")
    if arguments.results and arguments.inspect:
        parser.error("--results can't be combined with --inspect")
    try:
        if arguments.inspect:
            _inspect(arguments.inspect, arguments.output)
        else:
            _import(arguments.mapping, arguments.results or Path("results"))
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _import(mapping: Path, results: Path) -> None:
    done = run_import(mapping, results, progress=True)
    if done.recording.qualities:
        print("\n".join(table(done.recording)))
    if done.recording.left_out:
        print(f"{done.recording.left_out} samples are left out, because a stream has a gap there")
    print(done.split)
    for note in done.notes:
        print(f"warning: {note}", file=sys.stderr)
    print(f"{done.page}: plots of every modality; open it to see whether the mapping is right")
    print(f"{done.name}: in {results / 'datasets' / done.name}; train on it with 'scenarios=[{done.name}]'")


def _inspect(source: Path, output: Path | None) -> None:
    contents = inspect(source)
    print("\n".join(contents.lines))
    output = output or source.with_name(f"{source.stem}.yaml")
    try:
        with open(output, "x", encoding="utf-8") as file:
            file.write(first_mapping(contents, source, output.parent))
    except FileExistsError:
        raise FileExistsError(
            f"{output} is there already, and was not changed; name another file with --output MAPPING"
        ) from None
    print(f"{output}: a first mapping; edit it, then import it with `harness import {shlex.quote(str(output))}`")
    try:
        _harness.read_mapping(output)
    except ValueError as error:
        print(f"it can't be imported yet, because something could not be guessed: {error}")


if __name__ == "__main__":
    sys.exit(main())
