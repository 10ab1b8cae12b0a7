"""The command `harness`, also as `python -m harness`."""

import sys

from . import _harness


def main() -> None:
    sys.exit(_harness.main(["harness", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
