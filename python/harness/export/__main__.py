"""The command `harness export`, also as `python -m harness.export`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from harness.export import FORMATS, export


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="harness export", description="Writes a simulated dataset in another project's format."
    )
    parser.add_argument("--format", choices=FORMATS, required=True)
    parser.add_argument("dataset", type=Path, help="the dataset's folder, as in results/datasets")
    parser.add_argument("output", type=Path, help="the folder to write; it must not exist")
    parser.add_argument(
        "--episodes", type=int, nargs="+", metavar="N", help="these episodes; all, if not given"
    )
    arguments = parser.parse_args(words)
    try:
        print(export(arguments.dataset, arguments.format, arguments.output, arguments.episodes))
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
