"""``python -m dhtorch.ops``: compile the operators and print the path of the library.

Exit code 2 where that is not possible.
"""

from __future__ import annotations

import sys

from dhtorch.ops import loader


def main() -> int:
    """The exit code."""
    options = sys.argv[1:]
    if {"-h", "--help"} & set(options):
        print(loader.__doc__)
        return 0
    if options:
        print(f"found {options[0]!r}, expected no options: {loader.COMMAND}")
        return 2
    try:
        print(loader.build())
    except OSError as error:
        print(f"dhtorch.ops: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
