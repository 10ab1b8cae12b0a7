"""The command `harness`, also as `python -m harness`."""

import importlib
import sys

from . import _harness

# What Python does, with other projects' packages; all other commands are the program's own.
MODULES = {"export": "harness.export.__main__", "import": "harness.importing"}


def main() -> None:
    command, *arguments = sys.argv[1:] or [""]
    if command in MODULES:
        sys.exit(importlib.import_module(MODULES[command]).main(arguments))
    sys.exit(_harness.main(["harness", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
