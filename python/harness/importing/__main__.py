"""The command `harness import`, also as `python -m harness.importing`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

import polars as pl

from harness import _harness
from harness.importing import lag, run_import
from harness.importing.inspection import first_mapping, inspect
from harness.importing.recording import aligned, times

EXAMPLES = """examples:
  harness import mapping.yaml
  harness import --inspect recordings/trial_1.h5
  harness import --inspect bags --output lab.yaml
  harness import mapping.yaml --lag joints.angle force.z
"""


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="harness import",
        description="Import a recording as a dataset: a LeRobot dataset, Parquet, CSV, HDF5, zarr, MATLAB or\n"
        "NumPy files, or ROS 2 bags.",
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
    delay = "measure by how much a column comes after another, for example `joints.angle force.z`; imports nothing"
    parser.add_argument("--lag", nargs=2, metavar=("COLUMN", "COLUMN"), help=delay)
    longest = "the longest delay that --lag looks for, s [default: 1]"
    parser.add_argument("--max-lag", type=float, metavar="S", help=longest)
    output = "the file for the first mapping of --inspect [default: FILE.yaml], or for the trials' offsets of --lag"
    parser.add_argument("--output", type=Path, metavar="FILE", help=output)
    arguments = parser.parse_args(words)
    if (arguments.mapping is None) == (arguments.inspect is None):
        parser.error("name a mapping, or a recording with --inspect FILE")
    if arguments.lag and arguments.inspect:
        parser.error("--lag needs a mapping; --inspect FILE writes a first one")
    if arguments.output and not (arguments.inspect or arguments.lag):
        parser.error("--output needs --inspect FILE or --lag COLUMN COLUMN")
    if arguments.results and (arguments.inspect or arguments.lag):
        parser.error("--results can't be combined with --inspect or --lag, which import nothing")
    if arguments.max_lag is not None and not (arguments.lag and 0 < arguments.max_lag < 3600):
        parser.error("--max-lag needs --lag COLUMN COLUMN, and is above 0 and below 3600 s")
    try:
        if arguments.lag:
            _lag(arguments.mapping, tuple(arguments.lag), arguments.max_lag or 1.0, arguments.output)
        elif arguments.inspect:
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
    if streams := times(done.recording):
        print("\n".join(aligned([(*row[:5], *row[6:]) for row in streams])))
    if done.cleaned:
        print("\n".join(done.cleaned))
    print(done.split)
    for note in done.notes:
        print(f"warning: {note}", file=sys.stderr)
    print(f"{done.name}: in {results / 'datasets' / done.name}; train on it with 'scenarios=[{done.name}]'")
    where = [] if results == Path("results") else ["--results", str(results)]
    command = shlex.join(["harness", "report", "--dataset", done.name, *where])
    print(f"see every modality, and whether the mapping is right: {command}")


def _lag(mapping: Path, terms: tuple[str, str], longest_s: float, output: Path | None) -> None:
    found = lag.lags(mapping, terms, longest_s)
    print("\n".join(lag.table(found, terms)))
    if output:
        rows = [{"trial": each.trial, "offset_s": round(each.offset_s, 6)} for each in found]
        pl.DataFrame(rows).write_csv(output)
        stream = terms[1].partition(".")[0]
        print(
            f"{output}: the offset of each trial; say 'episodes: {output}' and in streams.{stream} 'offset_s: offset_s'"
        )


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
