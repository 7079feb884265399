"""``python -m dhtorch.ops``: compile the operators for this processor and print the path of the library.

Exit code 2 if that is not possible.
"""

from __future__ import annotations

import sys

from dhtorch.ops import builder, loader


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
        loader.check_torch_version()
        path = loader.library()
        if not path.is_file():
            compiler = builder.find_compiler()[0]
            print(
                f"compiling {len(loader.SOURCES)} files for {loader.level()} with {compiler}, up to 90 s",
                file=sys.stderr,
            )
        print(builder.build())
    except OSError as error:
        print(f"dhtorch.ops: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
