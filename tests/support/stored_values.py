"""Values that tests compare with, in JSON files beside them.

``DHTORCH_STORE=1 pytest PATH`` stores anew what the tests of PATH find, after a change that is meant.
"""

import json
import os

from support.digests import dump


def stored_values(file, found=None, names=None):
    """Name -> stored value. With ``DHTORCH_STORE`` set, the values of ``found`` replace the stored ones first, and what
    is not in ``names`` is removed."""
    values = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    if found and os.environ.get("DHTORCH_STORE"):
        values |= found
        values = {name: values[name] for name in (names or values) if name in values}
        file.write_text(dump(values), encoding="utf-8")
    return values
