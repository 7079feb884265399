"""``python -m dhtorch.ops``: compile the operators and print the path of the library.

Exit code 2 if that is not possible.
"""

from __future__ import annotations

import sys

from dhtorch.ops import loader


def main() -> int:
    """Command-line arguments -> exit code."""
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        print(loader.__doc__)
        return 0
    if arguments:
        print(f"{loader.COMMAND}: found {arguments[0]!r}, expected no arguments")
        return 2
    try:
        print(loader.build())
    except OSError as error:
        print(f"dhtorch.ops: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
