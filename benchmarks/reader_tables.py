"""Tables of readme.py: other projects' readers of our files, and a small radiance field with our depth."""

from collections.abc import Callable

from cells import percent, read, table

#: What the depth of a fit is, in words.
_DEPTHS = {"none": "none", "sensor": "returns up to the cutoff", "ours": "these and dhtorch's"}


def readers() -> str:
    """Reader × command that wrote its file: number of sources read, of all that were tried."""
    rows = read("readers_3d")
    sources = list(dict.fromkeys(row["source"] for row in rows))
    cells = []
    for reader, writer in dict.fromkeys((row["reader"], row["written_by"]) for row in rows):
        by_source = {r["source"]: r for r in rows if (r["reader"], r["written_by"]) == (reader, writer)}
        version = next(iter(by_source.values()))["version"] or ""
        states = [by_source[source]["state"] if source in by_source else "–" for source in sources]
        command = "dhtorch PATH" if writer == "recover" else f"dhtorch {writer}"
        cells.append([f"{reader} {version}".strip(), f"`{command}`", *states])
    return table(["reader", "written by", *sources], cells)


def field() -> str:
    """A row for each depth that the field was fitted with."""
    cells = []
    for row in read("tiny_field"):
        errors = [percent(row[k]) for k in ("depth_pixels", "median_rel", "mean_rel", "share_within_10")]
        cells.append([_DEPTHS[row["depth"]], *errors, f"{row['psnr']:.2f}"])
    head = ["depth", "rays with depth", "median error", "mean error", "within 10 %", "PSNR, dB"]
    return table(head, cells)


TABLES: dict[str, Callable[[], str]] = {"readers 3d": readers, "tiny field": field}
