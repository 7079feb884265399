"""Finding, checking and loading the compiled kernels of ``csrc``: optional, as every operator has a torch reference.

    pip install dhtorch             a wheel for this platform holds them, and they are in use
    python -m dhtorch.ops           compile them into the user's cache, with the system's C++ compiler
    DHTORCH_OPS=0 python …          use torch alone; DHTORCH_OPS=1: an error where they cannot be loaded

Which functions have a kernel, and for which tensors it runs: :mod:`dhtorch.ops.dispatch`. Agreement with the torch
reference, which the tests check (``tests/ops/test_compiled.py``):

- bit for bit: pixels of samples, flags and classes of holes, depth in metres, tokens, the sensor's map, census costs,
  their best surface;
- up to one rounding of a value: pyramids, sigma, statistics of windows around samples, where textures carry the
  rounding of their sums;
- up to the rounding of sums over a window, of the search for points and the registration of windows: half of the
  positions are equal or within 1e-4 px, 99 of 100 within a tenth of their sigma, at most one validity in 200 differs;
- poses: 99 of 100 within a hundredth of their sigma; fitted surfaces and filled planes: 99 of 100 depths within a tenth
  of their sigma, at most one gate in 200 differs.

A library is one file of one vector level (:data:`LEVELS`), chosen by the level that torch itself uses, and works with
any torch that has the stable ABI. Its name has a hash of its sources and its manifest (``.json``) the file's checksum:
a file of other sources, a changed one, or one that other users may write is not loaded; torch computes instead, and
one warning says why.

Without an argument: compile the operators for this processor and print the path of the library; exit code 2 if that is
not possible.
"""

import sys

from dhtorch.ops import builder, loader


def main() -> int:
    """Command-line arguments -> exit code."""
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        print(__doc__)
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
