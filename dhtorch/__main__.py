"""``python -m dhtorch`` is the ``dhtorch`` command."""

import sys

from dhtorch.cli.run import main

sys.exit(main())
