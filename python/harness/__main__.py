"""The command `harness`, also as `python -m harness`."""

import importlib
import sys

from . import _harness

# Commands that are written in Python, because they use other Python packages. The Rust program has all the others.
MODULES = {"export": "harness.export.__main__", "import": "harness.importing.__main__"}


def main() -> None:
    """Runs the command line and exits with its code."""
    command, *arguments = sys.argv[1:] or [""]
    if command in MODULES:
        try:
            module = importlib.import_module(MODULES[command])
        except ImportError as error:
            sys.exit(f"error: {error}")
        sys.exit(module.main(arguments))
    sys.exit(_harness.main(["harness", *sys.argv[1:]], [sys.executable, "-m", "harness"]))


if __name__ == "__main__":
    main()
