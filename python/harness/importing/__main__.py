"""The command `harness import`, also as `python -m harness.importing`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from harness.importing import run_import
from harness.importing.recording import table


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="harness import", description="Import a LeRobot dataset or Parquet files as a dataset."
    )
    parser.add_argument(
        "mapping", type=Path, help="YAML file that says what to import, and which columns are which modality"
    )
    folder = "folder of datasets and runs [default: results]"
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="DIR", help=folder)
    arguments = parser.parse_args(words)
    try:
        done = run_import(arguments.mapping, arguments.results, progress=True)
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if done.recording.qualities:
        print("\n".join(table(done.recording)))
    folder = arguments.results / "datasets" / done.name
    print(f"{done.name}: in {folder}; train on it with 'scenarios=[{done.name}]'")
    return 0


if __name__ == "__main__":
    sys.exit(main())
