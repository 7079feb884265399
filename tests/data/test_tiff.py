"""TIFF: what tifffile writes is read in its own type, and a directory that does not fit the file names the tag."""

import struct

import numpy as np
import pytest

from dhtorch.data.codecs.tiff import decode_tiff, decode_tiff_header, read_tiff, read_tiff_header
from dhtorch.data.io.decode import FormatError

tifffile = pytest.importorskip("tifffile")

#: Height and width: no multiple of a tile.
HW = (21, 35)


def numbers(dtype, samples=1):
    """Different values (h, w) or (h, w, samples) of a type."""
    shape = HW if samples == 1 else (*HW, samples)
    return (np.arange(np.prod(shape)).reshape(shape) % 120).astype(dtype)


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


@pytest.fixture
def grey(tmp_path):
    """Bytes of an uncompressed image of 16 bits, and the name that errors have."""
    file = tmp_path / "grey.tiff"
    tifffile.imwrite(file, numbers("u2"))
    return file.read_bytes(), file


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "i1", "i2", "i4", "f2", "f4", "f8"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_every_type_of_both_byte_orders_is_read_as_it_is_stored(dtype, order, tmp_path):
    file = tmp_path / "a.tiff"
    tifffile.imwrite(file, numbers(dtype), byteorder=order)
    image = read_tiff(file, HW)
    assert image.dtype == np.dtype(dtype) and np.array_equal(image, numbers(dtype))
    assert read_tiff_header(file) == (HW, 1, np.dtype(dtype))


@pytest.mark.parametrize("layout", [{"tile": (16, 16)}, {"rowsperstrip": 4}, {}])
@pytest.mark.parametrize("compression", [None, "deflate"])
@pytest.mark.parametrize("samples", [1, 3])
def test_tiles_and_strips_hold_the_same_image(layout, compression, samples, tmp_path):
    file = tmp_path / "a.tiff"
    photometric = "rgb" if samples == 3 else "minisblack"
    tifffile.imwrite(file, numbers("u2", samples), photometric=photometric, compression=compression, **layout)
    assert np.array_equal(read_tiff(file, HW, (1, 3)), numbers("u2", samples))
    assert read_tiff_header(file).samples == samples


@pytest.mark.parametrize("layout", [{"tile": (16, 16)}, {"rowsperstrip": 4}])
def test_strips_and_tiles_beyond_the_file_are_an_error(layout, tmp_path):
    file = tmp_path / "a.tiff"
    tifffile.imwrite(file, numbers("u2"), **layout)
    assert tifffile.TiffFile(file).pages[0].dataoffsets[-1] > 1000  # the image follows the directory
    with pytest.raises(FormatError, match=r"a\.tiff: strips: found \d+ offsets, \d+ sizes, expected all inside"):
        decode_tiff(file.read_bytes()[:-2], file)


@pytest.mark.parametrize(
    ("tag", "value", "named"),
    [
        (256, 34, "strips: found 1470 bytes, expected 1428 bytes"),
        (257, 22, "strips: found 1470 bytes, expected 1540 bytes"),
        (257, 0, "size: found 35x0, expected 1 to "),
        (258, 12, "samples: found 12 bits of kind u, expected 8, 16 or 32 bits integer"),
        (259, 7, "layout: found 1 samples per pixel, compression 7, photometric 1, planes 1"),
        (262, 3, "layout: found 1 samples per pixel, compression 1, photometric 3, planes 1"),
        (277, 2, "layout: found 2 samples per pixel"),
        (279, 1469, "strips: found 1469 bytes, expected 1470 bytes"),
        (279, 1 << 30, "strips: found 1 offsets, 1 sizes, expected all inside the file"),
    ],
)
def test_a_tag_that_does_not_fit_the_image_is_named(grey, tag, value, named):
    data, file = grey
    with pytest.raises(FormatError, match=named):
        decode_tiff(changed(data, tag, value), file)


def test_the_sample_format_is_the_kind_of_number(tmp_path):
    file = tmp_path / "a.tiff"
    tifffile.imwrite(file, numbers("i2"))
    data = file.read_bytes()
    assert decode_tiff_header(changed(data, 339, 3), file).dtype == np.dtype("f2")
    with pytest.raises(FormatError, match=r"samples: found 16 bits of kind \?"):
        decode_tiff_header(changed(data, 339, 4), file)


def test_a_size_that_is_not_the_required_one_is_named(grey):
    data, file = grey
    with pytest.raises(FormatError, match="size: found 35x21, expected 21x35"):
        decode_tiff(data, file, (35, 21))


@pytest.mark.parametrize(
    ("damaged", "named"),
    [
        (lambda data: b"II+\0" + data[4:], r"content: found b'II\+"),
        (lambda data: data[:7], "content"),
        (lambda data: data[:4] + struct.pack("<I", len(data)) + data[8:], "directory: found one beyond the"),
        (lambda data: data[: entry_at(data, 262)], "directory|strips"),
    ],
)
def test_a_damaged_directory_is_an_error(grey, damaged, named):
    data, file = grey
    with pytest.raises(FormatError, match=named):
        decode_tiff(damaged(data), file)


def test_bits_of_several_samples_must_be_equal(tmp_path):
    file = tmp_path / "a.tiff"
    tifffile.imwrite(file, numbers("u1", 3), photometric="rgb")
    data = bytearray(file.read_bytes())
    (bits_at,) = struct.unpack_from("<I", data, entry_at(data, 258) + 8)
    struct.pack_into("<H", data, bits_at, 16)
    with pytest.raises(FormatError, match="tag 258: found 2 different numbers, expected one"):
        decode_tiff(bytes(data), file, samples=(3,))
