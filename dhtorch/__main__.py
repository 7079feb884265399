"""``python -m dhtorch`` is the ``dhtorch`` command."""

import sys

from dhtorch.run import main

sys.exit(main())
