"""TIFF: what tifffile writes is read in its own type, and a directory that does not fit the file is an error."""

import struct

import numpy as np
import pytest

from dhtorch.data.codecs.tiff import decode_tiff, decode_tiff_header, read_tiff, read_tiff_header
from dhtorch.data.io.decode import FormatError

tifffile = pytest.importorskip("tifffile")

#: Height and width: no multiple of a tile.
HW = (21, 35)

ROWS = [
    *((dtype, 1, {"byteorder": order}) for dtype in ("u1", "u2", "u4", "i1", "i2", "i4", "f2", "f4", "f8") for order in "<>"),
    *(
        ("u2", samples, {"compression": compression, **layout})
        for layout in ({"tile": (16, 16)}, {"rowsperstrip": 4}, {})
        for compression in (None, "deflate")
        for samples in (1, 3)
    ),
]  # fmt: skip


def write(file, dtype="u2", samples=1, **options):
    """Different values (h, w) or (h, w, samples) of a type, as written to a file."""
    shape = HW if samples == 1 else (*HW, samples)
    values = (np.arange(np.prod(shape)).reshape(shape) % 120).astype(dtype)
    tifffile.imwrite(file, values, photometric="rgb" if samples == 3 else "minisblack", **options)
    return values


@pytest.mark.parametrize(("dtype", "samples", "options"), ROWS)
def test_every_type_and_layout_is_read_as_it_is_stored(dtype, samples, options, tmp_path):
    values = write(tmp_path / "a.tiff", dtype, samples, **options)
    image = read_tiff(tmp_path / "a.tiff", HW, (1, 3))
    assert image.dtype == np.dtype(dtype) and np.array_equal(image, values)
    assert read_tiff_header(tmp_path / "a.tiff") == (HW, samples, np.dtype(dtype))


def entry_at(data, tag):
    """Position of a tag's entry in the first directory of a little-endian file."""
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    places = [at + 2 + 12 * k for k in range(count)]
    return next(place for place in places if struct.unpack_from("<H", data, place)[0] == tag)


def changed(data, tag, value):
    """The file with another value of a tag that holds one number of 16 or 32 bits."""
    out, place = bytearray(data), entry_at(data, tag)
    kind, count = struct.unpack_from("<HI", data, place + 2)
    assert count == 1
    struct.pack_into({3: "<H", 4: "<I"}[kind], out, place + 8, value)
    return bytes(out)


@pytest.mark.parametrize(
    ("options", "damage", "named"),
    [
        *(
            ({}, lambda data, tag=tag, value=value: changed(data, tag, value), named)
            for tag, value, named in [
                (256, 34, "strips: found 1470 bytes, expected 1428 bytes"),
                (257, 22, "strips: found 1470 bytes, expected 1540 bytes"),
                (257, 0, "size: found 35x0, expected 1 to "),
                (258, 12, "samples: found 12 bits of kind 1, expected 8, 16 or 32 bits integer"),
                (259, 7, "layout: found 1 samples per pixel, compression 7, photometric 1, planes 1"),
                (262, 3, "layout: found 1 samples per pixel, compression 1, photometric 3, planes 1"),
                (277, 2, "layout: found 2 samples per pixel"),
                (279, 1469, "strips: found 1469 bytes, expected 1470 bytes"),
                (279, 1 << 30, "strips: found 1 offsets, 1 sizes, expected all inside the file"),
            ]
        ),
        ({"dtype": "i2"}, lambda data: changed(data, 339, 6), "samples: found 16 bits of kind 6"),
        ({"tile": (16, 16)}, lambda data: data[:-2], r"a\.tiff: strips: found 6 offsets, 6 sizes, expected all inside"),
        ({"rowsperstrip": 4}, lambda data: data[:-2], r"a\.tiff: strips: found 6 offsets, 6 sizes, expected all inside"),
        ({}, lambda data: b"II+\0" + data[4:], r"content: found b'II\+"),
        ({}, lambda data: data[:7], "content"),
        ({}, lambda data: data[:4] + struct.pack("<I", len(data)) + data[8:], "data: found IndexError"),
        ({}, lambda data: data[: entry_at(data, 262)], "data|strips"),
        (
            {"dtype": "u1", "samples": 3},  # another number of bits for one of the samples
            lambda data: data[: (at := struct.unpack_from("<I", data, entry_at(data, 258) + 8)[0])] + b"\20" + data[at + 1 :],
            r"samples: found \(16, 8, 8\) bits",
        ),
    ],
)  # fmt: skip
def test_a_file_that_does_not_fit_its_directory_is_an_error(options, damage, named, tmp_path):
    file = tmp_path / "a.tiff"
    write(file, **options)
    with pytest.raises(FormatError, match=named):
        decode_tiff(damage(file.read_bytes()), file, samples=(1, options.get("samples", 1)))
    with pytest.raises(FormatError, match="size: found 35x21, expected 21x35"):
        read_tiff(file, (35, 21), (1, 3))


def test_the_sample_format_is_the_kind_of_number(tmp_path):
    write(tmp_path / "a.tiff", "i2")
    assert decode_tiff_header(changed((tmp_path / "a.tiff").read_bytes(), 339, 3), tmp_path).dtype == np.dtype("f2")
